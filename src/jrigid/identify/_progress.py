"""Signs of life of a fit: a bar or lines on a terminal, a line for each stage."""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

_PATIENCE = 2.0  # seconds without a sign of life
_Show = Callable[[str], None]


@contextlib.contextmanager
def reporter(progress: bool | None) -> Iterator[Callable[[str], Any] | None]:
    """Yield what is called with a line of text after each stage, or None.

    It is a bar on a terminal where tqdm is installed.
    """
    if progress is not None or not sys.stderr.isatty():
        yield print if progress else None
        return
    with contextlib.ExitStack() as stack:
        try:
            from tqdm import tqdm
        except ModuleNotFoundError:
            show, wait = _late_lines()
        else:
            # The number of stages is not known beforehand: the bar has no end.
            bar = tqdm(
                unit=" stages", delay=_PATIENCE, leave=False, mininterval=0, miniters=1
            )
            stack.enter_context(bar)
            show, wait = _on_bar(bar)
        # The first stage ends seconds after it began where its program is compiled.
        timer = threading.Timer(_PATIENCE, wait, ["fit: compiles the first stage"])
        timer.daemon = True
        timer.start()
        stack.callback(timer.cancel)

        def show_stage(line: str) -> None:
            timer.cancel()
            show(line)

        yield show_stage


def _on_bar(bar: Any) -> tuple[_Show, _Show]:
    """Return functions that show a stage, and a text before the first one."""

    def show(line: str) -> None:
        bar.set_postfix_str(line, refresh=False)
        bar.update()

    return show, bar.set_postfix_str


def _late_lines() -> tuple[_Show, _Show]:
    """Return functions that print a stage after some seconds, and a text at once."""
    start = time.perf_counter()

    def wait(line: str) -> None:
        print(line, file=sys.stderr)

    def show(line: str) -> None:
        if time.perf_counter() - start > _PATIENCE:
            wait(line)

    return show, wait

"""Hand out blocks, try failed ones again, and show the progress."""

import contextlib
import queue
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import BrokenExecutor, Future
from typing import Any

from jrigid.sweep._work import Outcome, in_words

#: Function that has a block computed.
Submit = Callable[[int], Future[Outcome]]

_TRIALS = 3


def outcomes(
    submit: Submit, numbers: Iterable[int], ahead: int
) -> Generator[Outcome, None, None]:
    """Yield the outcome of each block, in the order in which they end.

    Args:
        submit: Has a block computed.
        numbers: The blocks.
        ahead: How many blocks are submitted at a time. Their points are in memory.
    """
    waiting = deque(numbers)
    trials = Counter[int]()
    ended: queue.SimpleQueue[Future[Outcome]] = queue.SimpleQueue()
    running: dict[Future[Outcome], int] = {}
    try:
        while waiting or running:
            while waiting and len(running) < ahead:
                future = submit(waiting[0])
                running[future] = waiting.popleft()
                future.add_done_callback(ended.put)
            future = ended.get()
            outcome = _outcome(running.pop(future), future)
            trials[outcome.number] += 1
            if outcome.error is None or trials[outcome.number] == _TRIALS:
                yield outcome
            else:
                # At the end of the queue a block that fails holds up no other.
                waiting.append(outcome.number)
    except BrokenExecutor as error:
        raise RuntimeError(
            "A worker of the executor died, and with it the executor. What a store "
            "has is kept, and the same call with a new executor goes on from there."
        ) from error
    finally:
        # After an error or an interrupt no further block begins.
        for future in running:
            future.cancel()


def _outcome(number: int, future: Future[Outcome]) -> Outcome:
    """The outcome of a block, also where its worker could not return it.

    Raises:
        Exception: No other trial or block can do better.
    """
    # `exception` of a cancelled future raises an error instead of returning it.
    if future.cancelled():
        return Outcome(number, error="The executor gave the block up.")
    error = future.exception()
    if isinstance(error, BrokenExecutor):
        raise error
    if isinstance(error, ImportError):
        raise ImportError(
            f"A worker lacks a package: {error}. (Workers need jrigid, and what the "
            "function imports, in the versions that are here.)"
        ) from error
    if error is not None:
        return Outcome(number, error=in_words(error))
    outcome = future.result()
    if outcome.final is not None:
        raise outcome.final(outcome.error)
    return outcome


@contextlib.contextmanager
def meter(
    total: int, done: int, shown: bool
) -> Generator[Callable[[int], Any], None, None]:
    """Show how many points are done: a bar if tqdm is installed, else lines.

    Yields:
        A function to call with a number of points that have been finished.
    """
    if not shown:
        yield lambda _: None
        return
    try:
        from tqdm import tqdm
    except ModuleNotFoundError:
        yield _lines(total, done)
    else:
        with tqdm(total=total, initial=done, unit="pt", unit_scale=True) as bar:
            yield bar.update


def _lines(total: int, done: int) -> Callable[[int], None]:
    """Print how many points are done, every five seconds."""
    last = time.monotonic()

    def advance(points: int) -> None:
        nonlocal done, last
        done += points
        if done == total or time.monotonic() > last + 5:
            last = time.monotonic()
            print(f"{done} of {total} points", file=sys.stderr, flush=True)

    return advance

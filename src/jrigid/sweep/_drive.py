"""Blocks handed out, tried again where they failed, and counted."""

import contextlib
import queue
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Future
from typing import Any

from jrigid.sweep._work import Outcome, in_words

_TRIALS = 3


def outcomes(
    submit: Callable[[int], Future], numbers: Iterable[int], ahead: int
) -> Iterator[Outcome]:
    """What became of each block, in the order in which they end.

    Args:
        submit: Has a block computed.
        numbers: The blocks.
        ahead: How many are on their way at a time.
    """
    waiting, trials = deque(numbers), Counter[int]()
    ended: queue.SimpleQueue[Future] = queue.SimpleQueue()
    running: dict[Future, int] = {}
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
                waiting.append(outcome.number)
    except BrokenExecutor as error:
        raise RuntimeError(
            "A worker of the executor died, and with it the executor. What a store "
            "has is kept, and the same call with a new executor goes on from there."
        ) from error
    finally:
        for future in running:
            future.cancel()


def _outcome(number: int, future: Future) -> Outcome:
    """What became of a block, also where its worker could not say so."""
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
    outcome: Outcome = future.result()
    if outcome.final is not None:
        raise outcome.final(outcome.error)
    return outcome


@contextlib.contextmanager
def meter(total: int, done: int, shown: bool) -> Iterator[Callable[[int], Any]]:
    """Shows how many points are done, if wanted: a bar where there is tqdm, else a line."""
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
    """Says how many points are done, every few seconds."""
    said = time.monotonic()

    def say(points: int) -> None:
        nonlocal done, said
        done += points
        if done == total or time.monotonic() > said + 5:
            said = time.monotonic()
            print(f"{done} of {total} points", file=sys.stderr, flush=True)

    return say

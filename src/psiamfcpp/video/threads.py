"""Reading ahead of a loop and writing behind it, in a thread each, so that both overlap with the loop's own work."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import ParamSpec, TypeVar

Item = TypeVar("Item")
"""anything but None, which stands for the end"""
Arguments = ParamSpec("Arguments")

_DEPTH = 4
"""frames that wait at most; enough for the slowest of a few, little enough for 4K frames"""


@contextlib.contextmanager
def ahead(items: Iterator[Item]) -> Iterator[Iterator[Item]]:
    """Have a few items read in a thread before they are asked for.

    What reading raises is raised where the item is asked for. Not for live sources: their items would grow old.
    """
    with ThreadPoolExecutor(1, "read ahead") as thread:
        read = _ahead(thread, items)
        try:
            yield read
        finally:
            read.close()


def _ahead(thread: ThreadPoolExecutor, items: Iterator[Item]) -> Generator[Item, None, None]:
    waiting: deque[Future[Item | None]] = deque()
    try:
        while True:
            while len(waiting) < _DEPTH:
                waiting.append(thread.submit(next, items, None))
            item = waiting.popleft().result()
            if item is None:
                return
            yield item
    finally:
        for future in waiting:
            future.cancel()


@contextlib.contextmanager
def behind(work: Callable[Arguments, None]) -> Iterator[Callable[Arguments, None]]:
    """Have calls carried out in a thread, in their order; the ``with`` block ends after the last of them.

    What a call raises is raised by one of the next, or at the end; the calls after it are not carried out.
    """
    waiting: deque[Future[None]] = deque()
    failed = threading.Event()

    def attempt(*args: Arguments.args, **kwargs: Arguments.kwargs) -> None:
        if failed.is_set():
            return
        try:
            work(*args, **kwargs)
        except BaseException:
            failed.set()
            raise

    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> None:
        # handed over first, so that an interruption of the wait loses nothing
        waiting.append(thread.submit(attempt, *args, **kwargs))
        while waiting and (waiting[0].done() or len(waiting) > _DEPTH):
            waiting[0].result()
            waiting.popleft()

    with ThreadPoolExecutor(1, "write behind") as thread:
        yield call
        for future in waiting:
            future.result()

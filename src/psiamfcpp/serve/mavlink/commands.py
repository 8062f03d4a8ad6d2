"""Carries out commands apart from the thread that hears them, and each of them once, however often it is sent."""

from __future__ import annotations

import queue
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass

from pymavlink.dialects.v20 import common as mav

# MAVLink repeats a command that was not answered; MAVSDK after 0.5 s, three times, others more slowly.
_REPEATED_WITHIN_S = 5.0
_MOST_REPEATS = 10
_WAITING, _WAITING_PER_CLIENT = 16, 4
_CLIENTS, _REMEMBERED = 64, 8


@dataclass(eq=False)
class _Given:
    key: Hashable
    at: float
    result: int | None = None
    """None until it was carried out"""
    repeats: int = 0
    """how often it was sent again meanwhile"""


class Commands:
    """A thread that carries out commands one after the other, while its ``with`` block lasts."""

    def __init__(self, failed: Callable[[Exception], None], clock: Callable[[], float] = time.monotonic):
        """Prepare the thread.

        Args:
            failed: receives what a command raised that it should not have.
            clock: gives seconds.
        """
        self._failed, self._clock = failed, clock
        self._lock = threading.Lock()
        self._recent: OrderedDict[str, deque[_Given]] = OrderedDict()
        self._waiting: queue.Queue[Callable[[], None] | None] = queue.Queue()
        self._thread = threading.Thread(target=self._run, name="mavlink commands", daemon=True)

    def __enter__(self) -> Commands:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._waiting.put(None)
        self._thread.join()

    def give(
        self, client: str, key: Hashable, again: bool, work: Callable[[], int], answer: Callable[[int], None]
    ) -> None:
        """Have a command carried out, and answered with its ``MAV_RESULT``.

        The same command of the same client within five seconds is answered with the result of the first, or
        IN_PROGRESS while there is none yet. A command that another one came after is the same only where its sender
        says that it sends it again.

        Args:
            client: who sent it.
            key: what it asks for.
            again: its sender says that it sent it before (COMMAND_LONG's ``confirmation``).
            work: carries it out, in the thread for that, and gives the result.
            answer: sends a result; called in this thread or the other.
        """
        with self._lock:
            recent = self._of(client)
            found = next((given for given in reversed(recent) if self._same(given, key, again, recent)), None)
            if found is None:
                result = self._begin(client, recent, _Given(key, self._clock()), work, answer)
            elif found.result is None:
                found.repeats += 1
                flood = found.repeats > _MOST_REPEATS
                result = mav.MAV_RESULT_TEMPORARILY_REJECTED if flood else mav.MAV_RESULT_IN_PROGRESS
            else:
                result = found.result
        if result is not None:
            answer(result)

    def _begin(
        self,
        client: str,
        recent: deque[_Given],
        given: _Given,
        work: Callable[[], int],
        answer: Callable[[int], None],
    ) -> int | None:
        """Queue a command; its result where it cannot be."""
        mine = sum(other.result is None for other in recent)
        if self._waiting.qsize() >= _WAITING or mine >= _WAITING_PER_CLIENT:
            return int(mav.MAV_RESULT_TEMPORARILY_REJECTED)
        recent.append(given)

        def carry_out() -> None:
            result = int(mav.MAV_RESULT_FAILED)
            try:
                result = work()
            finally:
                with self._lock:
                    given.result = result
                    if result != mav.MAV_RESULT_ACCEPTED and given in recent:
                        # nothing was done, so it may be tried again
                        recent.remove(given)
                answer(result)

        self._waiting.put(carry_out)
        return None

    def _same(self, given: _Given, key: Hashable, again: bool, recent: deque[_Given]) -> bool:
        if given.key != key:
            return False
        if given.result is None:
            return True
        return self._clock() - given.at <= _REPEATED_WITHIN_S and (again or given is recent[-1])

    def _of(self, client: str) -> deque[_Given]:
        recent = self._recent.setdefault(client, deque(maxlen=_REMEMBERED))
        self._recent.move_to_end(client)
        if len(self._recent) > _CLIENTS:
            self._recent.popitem(last=False)
        return recent

    def _run(self) -> None:
        while (carry_out := self._waiting.get()) is not None:
            try:
                carry_out()
            except Exception as error:  # a fault of ours here must not end the tracking
                self._failed(error)

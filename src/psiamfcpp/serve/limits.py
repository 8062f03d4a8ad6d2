"""Limits on how often: token buckets, one for everybody or one per address."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable

# Addresses that are remembered; beyond, the one that was heard longest ago is forgotten.
_MOST_KEYS = 1024


class Bucket:
    """A rate limit that allows short bursts (a token bucket)."""

    def __init__(self, per_s: float, at_once: float, clock: Callable[[], float] = time.monotonic):
        self._per_s, self._at_once, self._clock = per_s, at_once, clock
        self._lock = threading.Lock()
        self._left, self._at = at_once, clock()

    def take(self, count: float = 1.0) -> bool:
        """Take one, or N; whether it was allowed."""
        with self._lock:
            self._refill()
            if self._left < count:
                return False
            self._left -= count
            return True

    def empty(self) -> bool:
        """Whether the next `take` would be refused."""
        with self._lock:
            self._refill()
            return self._left < 1

    def _refill(self) -> None:
        now = self._clock()
        self._left = min(self._at_once, self._left + (now - self._at) * self._per_s)
        self._at = now


class Buckets:
    """A token bucket per key, such as an address, so that one sender cannot use up what is meant for another."""

    def __init__(self, per_s: float, at_once: float, clock: Callable[[], float] = time.monotonic):
        self._per_s, self._at_once, self._clock = per_s, at_once, clock
        self._lock = threading.Lock()
        self._buckets: OrderedDict[Hashable, Bucket] = OrderedDict()

    def take(self, key: Hashable) -> bool:
        """Take one of the key's; whether it was allowed."""
        return self._of(key).take()

    def empty(self, key: Hashable) -> bool:
        """Whether the key's next `take` would be refused."""
        return self._of(key).empty()

    def _of(self, key: Hashable) -> Bucket:
        with self._lock:
            if key not in self._buckets:
                self._buckets[key] = Bucket(self._per_s, self._at_once, self._clock)
            self._buckets.move_to_end(key)
            if len(self._buckets) > _MOST_KEYS:
                self._buckets.popitem(last=False)
            return self._buckets[key]

"""The last frames of a stream, so that a box drawn on an older one can catch up."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from psiamfcpp.geometry import Image

MOST_BYTES = 128 * 1024 * 1024
"""48 frames of 1280x720, or 21 of 1920x1080"""
# A page that was closed in the middle of drawing must not keep its frame for ever.
HOLD_S = 120.0
_FEWEST = 4


class Ring:
    """Keeps the newest frames of a stream in bounded memory; safe to use from several threads.

    While somebody holds a frame, it stays, and the frames after it are thinned out instead of dropped: there is always
    a chain of frames from the held one to the newest, of larger and larger steps the longer it is held.
    """

    def __init__(self, most_bytes: int = MOST_BYTES, clock: Callable[[], float] = time.monotonic):
        self._most_bytes, self._clock = most_bytes, clock
        self._lock = threading.Lock()
        self._frames: deque[tuple[int, Image]] = deque()
        self._bytes = 0
        self._holds: dict[str, tuple[int, float]] = {}

    def add(self, number: int, image: Image) -> None:
        """Keep a frame ``(H, W, 3)``; its number is larger than those before."""
        with self._lock:
            self._frames.append((number, image))
            self._bytes += image.nbytes
            while self._bytes > self._most_bytes and len(self._frames) > _FEWEST:
                if not self._shrink():
                    break

    def hold(self, who: str, number: int) -> bool:
        """Keep a frame until it is released, or for `HOLD_S`; whether it was still there. Each holder has one frame."""
        with self._lock:
            if all(kept != number for kept, _ in self._frames):
                return False
            self._holds[who] = number, self._clock()
            return True

    def release(self, who: str) -> None:
        """Hold nothing for somebody any more."""
        with self._lock:
            self._holds.pop(who, None)

    def since(self, number: int) -> list[tuple[int, Image]]:
        """Return the frames from a number to the newest one, thinned out where it was held; none where it is gone."""
        with self._lock:
            found = [frame for frame in self._frames if frame[0] >= number]
            return found if found and found[0][0] == number else []

    def clear(self) -> None:
        """Forget all frames."""
        with self._lock:
            self._frames.clear()
            self._holds.clear()
            self._bytes = 0

    def _shrink(self) -> bool:
        """Drop the oldest frame or, from the first held one on, every second; whether there was one to drop."""
        now = self._clock()
        self._holds = {who: hold for who, hold in self._holds.items() if now - hold[1] <= HOLD_S}
        held = {number for number, _ in self._holds.values()}
        if not held or self._frames[0][0] < min(held):
            self._bytes -= self._frames.popleft()[1].nbytes
            return True
        last = len(self._frames) - 1
        kept = [f for at, f in enumerate(self._frames) if at % 2 == 0 or at == last or f[0] in held]
        dropped = len(kept) < len(self._frames)
        self._frames = deque(kept)
        self._bytes = sum(image.nbytes for _, image in kept)
        return dropped


def stepping_stones(frames: list[tuple[int, Image]], most: int) -> list[Image]:
    """Return at most N of the frames, evenly spread, the last one included.

    Args:
        frames: numbered images, in order.
        most: how many at most; at least 1.
    """
    count = min(most, len(frames))
    return [frames[round((at + 1) * len(frames) / count) - 1][1] for at in range(count)]

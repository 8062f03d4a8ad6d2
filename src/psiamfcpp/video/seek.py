"""A video file that can be read from any frame, with frames counted as reading from the first one counts them."""

from __future__ import annotations

from bisect import bisect_left
from pathlib import Path

import cv2
import numpy as np

from psiamfcpp.geometry import Image
from psiamfcpp.video.capture import open_capture

# Frames before the wanted one at which a jump aims; files differ in how far their decoders come off.
_MARGINS = (0, 16, 150)
# Decoding this number of frames is no slower than a jump.
_NEAR = 30


class Reel:
    """Reads a video file by OpenCV, and goes to any frame by its number.

    A container's own idea of frame numbers is an estimate where the rate varies or the index is wrong. So numbers are
    counted while decoding, with the time stamp of each frame; a jump back is checked against these stamps, and where
    they do not agree, the file is read anew from its start.
    """

    def __init__(self, path: Path):
        """Open the file; whether a frame can be read is for the caller to ask."""
        self._path = path
        self.capture = self._open()
        self.next = 0
        """number of the frame that is read next"""
        self._stamps: list[float] = []
        self._ordered = True

    def read(self) -> Image | None:
        """Return the next frame ``(H, W, 3)`` uint8 BGR, or None at the end."""
        ok, frame = self.capture.read()
        if not ok:
            return None
        self._count()
        return np.asarray(frame, dtype=np.uint8)

    @property
    def position_s(self) -> float:
        """Time stamp of the frame that was read last, seconds."""
        return self.capture.get(cv2.CAP_PROP_POS_MSEC) / 1000

    def seek(self, number: int) -> None:
        """Go to a frame, or to the end where there is none of that number."""
        known = number <= len(self._stamps)
        far = number < self.next or (known and number > self.next + _NEAR)
        if far and not (self._ordered and known and self._jump(number)):
            self._rewind()
        while self.next < number and self.capture.grab():
            self._count()

    def close(self) -> None:
        """Close the file."""
        self.capture.release()

    def _open(self) -> cv2.VideoCapture:
        # absolute, since FFmpeg takes what stands before a colon in a bare name for a protocol
        return open_capture(str(self._path.absolute()), None)

    def _rewind(self) -> None:
        self.capture.release()
        self.capture = self._open()
        self.next = 0

    def _count(self) -> None:
        if self.next == len(self._stamps):
            stamp = self.position_s
            self._ordered &= not self._stamps or stamp > self._stamps[-1]
            self._stamps.append(stamp)
        self.next += 1

    def _jump(self, number: int) -> bool:
        """Have the container seek; whether the next frame is certain to be ``number``."""
        for margin in _MARGINS:
            if number - 1 - margin < 0:
                return False
            self.capture.set(cv2.CAP_PROP_POS_FRAMES, number - 1 - margin)
            while self.capture.grab():
                at = self._number_at(self.position_s)
                if at is None or at >= number:
                    break
                if at == number - 1:
                    self.next = number
                    return True
        return False

    def _number_at(self, stamp: float) -> int | None:
        """The frame of a time stamp, if there was one of just that stamp."""
        at = bisect_left(self._stamps, stamp - 1e-4)
        return at if at < len(self._stamps) and abs(self._stamps[at] - stamp) <= 1e-4 else None

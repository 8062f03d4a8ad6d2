"""JPEGs of the newest frame, each made once however many clients want it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Executor

import cv2
import numpy as np

from psiamfcpp.geometry import Image
from psiamfcpp.serve.follower import Shot
from psiamfcpp.video.drawing import draw_targets

_QUALITY = 80
# A browser on a field laptop shows no more, and a radio link carries no more.
_LARGEST_SIDE = 1280


def plain(shot: Shot) -> Image:
    """The frame as it came."""
    return shot.image


def annotated(shot: Shot) -> Image:
    """The frame with what was found in it."""
    return draw_targets(shot.image, shot.tracks)


class Pictures:
    """Makes JPEGs in other threads than that of the server."""

    def __init__(self, draw: Callable[[Shot], Image], executor: Executor):
        self._draw, self._executor = draw, executor
        self._shot: Shot | None = None
        self._made: asyncio.Future[bytes] | None = None

    async def get(self, shot: Shot) -> bytes:
        """The JPEG of a shot."""
        if self._made is None or self._shot is not shot:
            self._shot = shot
            self._made = asyncio.get_running_loop().run_in_executor(self._executor, self._make, shot)
        # a client that leaves while waiting must not take the image from the others
        return await asyncio.shield(self._made)

    def _make(self, shot: Shot) -> bytes:
        return jpeg(self._draw(shot))


def jpeg(image: Image, largest_side: int | None = _LARGEST_SIDE, quality: int = _QUALITY) -> bytes:
    """Return an image ``(H, W, 3)`` BGR as JPEG, made smaller where a side is longer than allowed."""
    scale = 1.0 if largest_side is None else largest_side / max(image.shape[:2])
    if scale < 1:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    ok, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise RuntimeError("a frame could not be made a JPEG")
    return data.tobytes()

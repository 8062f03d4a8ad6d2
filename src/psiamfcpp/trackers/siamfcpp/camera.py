"""How the camera moved from one frame to the next, so that a place in the world is found again while it pans."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from psiamfcpp.geometry import Image
from psiamfcpp.trackers.siamfcpp.procedure import Target

Motion = NDArray[np.float64]
"""``(2, 3)``: from pixels of the frame before to pixels of this one"""

STILL: Motion = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""the motion of a camera that stands still"""

# The flow is computed on grey frames of at most this width, in pixels; larger ones cost more and say no more.
_WIDTH = 320
_WINDOW, _LEVELS = (9, 9), 3
# Corners are chosen at half that width, which costs a quarter.
_POINTS, _QUALITY, _APART = 60, 0.01, 4
# Fewer points that move together than this, or a smaller share of all, are no camera motion: a cut, or water.
_FEWEST, _SHARE = 12, 0.4
# Number of places that move by themselves and are searched in turn.
_MOVERS = 4
# Two grey frames that differ by less than this on the mean show the same moment: the video stands still.
_FROZEN = 0.05


class Camera:
    """Motion of the camera between the frames it is shown; sparse optical flow and a robust similarity."""

    def __init__(self) -> None:
        self._before: NDArray[np.uint8] | None = None
        self._change: NDArray[np.uint8] | None = None
        self._factor = 1.0

    def forget(self) -> None:
        """Begin anew with the next frame."""
        self._before = self._change = None

    def step(self, frame: Image, apart: Target) -> Motion | None:
        """Take the next frame and return how the camera moved.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR.
            apart: box in the frame before whose points are left out, since what is in it moves by itself.

        Returns:
            The motion; that of a camera at rest for the first frame, or where no motion is found (a cut). None where
            the frame repeats the one before: the video stands still.
        """
        self._factor = factor = min(_WIDTH / frame.shape[1], 1.0)
        reduced = cv2.resize(frame, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        grey = np.asarray(cv2.cvtColor(reduced, cv2.COLOR_BGR2GRAY), np.uint8)
        before, self._before, self._change = self._before, grey, None
        if before is None or before.shape != grey.shape:
            return STILL
        if cv2.norm(before, grey, cv2.NORM_L1) < _FROZEN * grey.size:
            return None
        motion = _similarity(before, grey, _without(grey.shape, apart, factor))
        if motion is None:
            return STILL
        # Where the frame before shows nothing, nothing has changed.
        warped = cv2.warpAffine(before, motion, grey.shape[::-1], dst=grey.copy(), borderMode=cv2.BORDER_TRANSPARENT)
        self._change = np.asarray(cv2.absdiff(warped, grey), np.uint8)
        motion[:, 2] /= factor
        return motion

    def movers(self, side: float) -> list[tuple[float, float]]:
        """Return the places that changed most against the camera's motion, pixels of the last frame, the most first.

        Args:
            side: of what moves, in pixels.
        """
        if self._change is None:
            return []
        size = max(round(side * self._factor), 3)
        change, places = cv2.blur(self._change, (size, size)), list[tuple[float, float]]()
        while len(places) < _MOVERS:
            _, most, _, (x, y) = cv2.minMaxLoc(change)
            if most == 0:
                break
            places.append((x / self._factor, y / self._factor))
            cv2.circle(change, (x, y), size, 0, cv2.FILLED)
        return places


def moved(t: Target, motion: Motion) -> Target:
    """Return where a place of the frame before is in this frame, and how large."""
    cx, cy = motion @ (t.cx, t.cy, 1.0)
    zoom = float(np.hypot(motion[0, 0], motion[1, 0]))
    return Target(float(cx), float(cy), t.w * zoom, t.h * zoom)


def _without(shape: tuple[int, ...], t: Target, factor: float) -> NDArray[np.uint8]:
    """Return a mask ``(H, W)`` with 0 in the target's box and 255 elsewhere."""
    mask = np.full(shape, 255, np.uint8)
    left, top, right, bottom = (
        max(int(v * factor), 0) for v in (t.cx - t.w / 2, t.cy - t.h / 2, t.cx + t.w / 2 + 1, t.cy + t.h / 2 + 1)
    )
    mask[top:bottom, left:right] = 0
    return mask


def _similarity(before: NDArray[np.uint8], after: NDArray[np.uint8], mask: NDArray[np.uint8]) -> Motion | None:
    """Return the similarity that most points follow, in pixels of the reduced frames; None if there is none."""
    half, half_mask = (
        cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in (before, mask)
    )
    points = cv2.goodFeaturesToTrack(half, _POINTS, _QUALITY, _APART, mask=half_mask)
    if points is None or len(points) < _FEWEST:
        return None
    points = 2 * points + np.float32(0.5)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, np.zeros_like(points), winSize=_WINDOW, maxLevel=_LEVELS
    )
    kept = status.ravel() > 0
    if kept.sum() < _FEWEST:
        return None
    motion, inliers = cv2.estimateAffinePartial2D(points[kept], found[kept], ransacReprojThreshold=1.0, maxIters=200)
    if motion is None or inliers.sum() < max(_FEWEST, _SHARE * len(points)):
        return None
    return np.asarray(motion, np.float64)

"""What Staple-CA and MCCT-H share: areas about the target, colour histograms, and responses on a grid of pixels.

Bertinetto, Valmadre, Golodetz, Miksik, Torr, "Staple: complementary learners for real-time tracking", CVPR 2016.
Patches are resized so that the background area always has the same number of pixels, the *normal* size.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from psiamfcpp.geometry import FloatArray, Image
from psiamfcpp.trackers.dcf.features import Float, grey
from psiamfcpp.trackers.dcf.fourier import Real
from psiamfcpp.trackers.dcf.geometry import Pixels, Size, cut, resize_auto, round_half_away, whole

BINS = 32
HISTOGRAM = BINS**3
CELL = 4


@dataclass(frozen=True)
class Areas:
    """Whole sizes ``(rows, columns)`` about a target, in pixels of the frame."""

    target: FloatArray
    background: FloatArray
    foreground: FloatArray
    """inner part of the target"""
    factor: float
    """normal pixels per pixel of the frame"""


@dataclass(frozen=True)
class Rule:
    """How large the areas about a target are.

    Attributes:
        frame: rows and columns of the frame; a background that exceeds it becomes smaller by one pixel.
        fixed_area: normal pixels of the background.
        padding: background about the target, in mean sides.
        inner: rim of the target that is no foreground, in mean sides.
    """

    frame: tuple[int, ...]
    fixed_area: float
    padding: float
    inner: float

    def areas(self, size: FloatArray) -> Areas:
        """Areas of a target of these rows and columns, which are rounded."""
        target = np.maximum(round_half_away(size), 1)
        mean, frame = float(target.mean()), np.asarray(self.frame, np.float64)
        background = round_half_away(target + self.padding * mean)
        background = np.where(background > frame, frame - 1, background)
        background = np.maximum(background - np.mod(background - target, 2), 2)
        foreground = round_half_away(target - self.inner * mean)
        foreground = foreground + np.mod(background - foreground, 2)
        return Areas(target, background, foreground, float(np.sqrt(self.fixed_area / np.prod(background))))


@dataclass(frozen=True)
class Normal:
    """Normal sizes, those of the first frame throughout."""

    background: Size
    cells: Size
    target: FloatArray

    @classmethod
    def of(cls, areas: Areas) -> Normal:
        """Normal sizes of the first frame's areas."""
        background = round_half_away(areas.background * areas.factor)
        target = np.clip(round_half_away(0.75 * background - 0.25 * background[::-1]), 1, background)
        return cls(whole(np.maximum(background, CELL)), whole(np.maximum(background, CELL) // CELL), target)


def patch(frame: Image, position: ArrayLike, area: FloatArray, size: Size) -> Pixels:
    """Patch of an area about a position (row, column, 1-based), resized: indices ``round(c + (1 .. n) - n / 2)``."""
    n = np.maximum(np.floor(area), 2)
    first = round_half_away(np.asarray(position) + 1 - n / 2) - 1
    return resize_auto(cut(frame, first, whole(n)), size)


def label(size: Size, sigma: float) -> FloatArray:
    """Gaussian whose peak is the last element; at even sizes one row or column stays zero, as in the authors' code."""
    sides = []
    for n in size:
        half = (n - 1) // 2
        r, side = np.arange(-half, half + 1), np.zeros(n)
        side[(r - 1) % n] = np.exp(-(r**2) / (2 * sigma**2))
        sides.append(side)
    return np.outer(*sides)


def on_pixels(responses: Real, side: int) -> Real:
    """Middles, an odd number of cells wide, of responses ``(..., rows, columns)`` as ``(..., side, side)`` pixels."""
    half = max(int((side / CELL - 1) // 2), 0)
    reach = np.arange(-half, half + 1)
    rows, columns = (np.mod(reach - 1, n) for n in responses.shape[-2:])
    middle = responses[..., rows[:, None], columns].astype(np.float64)
    resized = [resize_auto(m, (side, side)) for m in middle.reshape(-1, *middle.shape[-2:])]
    return np.stack(resized).reshape(*responses.shape[:-2], side, side)


def grey_of_cells(resized: Pixels) -> Float:
    """``grey / 255 - 0.5`` of a patch that was resized to the grid of cells, ``(rows, columns)``."""
    return grey(resized).astype(np.float32) / np.float32(255) - np.float32(0.5)


class Histograms:
    """Colours of foreground and background, 32 bins per channel (Staple, section 3.4)."""

    def __init__(self) -> None:
        self._seen: FloatArray | None = None
        self._share = np.zeros(HISTOGRAM, np.float32)

    def update(self, normal: Pixels, areas: Areas, rate: float) -> None:
        """Blend the colours of a patch of normal size in; the first patch counts fully.

        Args:
            normal: ``(rows, columns, 3)`` uint8.
            areas: where background and foreground lie; their masks are laid over the patch, whatever its area.
            rate: learning rate.
        """
        bins = _bins(normal)
        size = bins.shape
        masks = (
            _rectangle(areas.background, areas.target, True, size),
            _rectangle(areas.background, areas.foreground, False, size),
        )
        counts = np.stack([np.bincount(bins[m], minlength=HISTOGRAM) for m in masks]).astype(np.float64)
        counts /= np.maximum(counts.sum(axis=1, keepdims=True), 1)
        self._seen = counts if self._seen is None else self._seen + rate * (counts - self._seen)
        background, foreground = self._seen
        total = background + foreground
        self._share = np.divide(foreground, total, out=np.zeros(HISTOGRAM), where=total > 0).astype(np.float32)

    def likelihood(self, pixels: Pixels) -> Float:
        """Probability of foreground, ``(rows, columns)``, of each pixel of a patch; 0 for a colour never seen."""
        return self._share[_bins(pixels)]


def centre_likelihood(likelihood: Float, target: Size) -> FloatArray:
    """Mean likelihood in every window of the target's size that lies inside."""
    rows, columns = target
    sums = cv2.integral(likelihood, sdepth=cv2.CV_64F)
    inside = sums[rows:, columns:] - sums[:-rows, columns:] - sums[rows:, :-columns] + sums[:-rows, :-columns]
    return inside / (rows * columns)


def _bins(pixels: Pixels) -> np.ndarray:
    high = pixels >> 3
    return high[..., 0].astype(np.int32) + (high[..., 1].astype(np.int32) << 5) + (high[..., 2].astype(np.int32) << 10)


def _rectangle(area: FloatArray, inner: FloatArray, outside: bool, size: Size) -> np.ndarray:
    """Mask of the inside or the outside of a rectangle in the middle of an area, resized."""
    rows, columns = whole(area)
    mask = np.full((rows, columns), outside, np.uint8)
    margin = (area - inner) / 2
    top, left = (max(int(m), 1) if m > 0 else 1 for m in margin)
    mask[top : rows - top, left : columns - left] = not outside
    return resize_auto(mask, size).astype(bool)

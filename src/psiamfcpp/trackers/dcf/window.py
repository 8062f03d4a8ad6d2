"""The square search window of BACF, STRCF, ARCF-HC and AutoTrack: its geometry, its samples, its responses."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from psiamfcpp.geometry import FloatArray
from psiamfcpp.trackers.dcf import fourier
from psiamfcpp.trackers.dcf.features import fhog, grey_hog_names
from psiamfcpp.trackers.dcf.geometry import Pixels, Size, crop, resize_auto, round_half_away, whole

Features = Callable[[Pixels, int], NDArray[np.float32]]
"""patch and cell -> ``(C, h // cell, w // cell)``"""


@dataclass(frozen=True, slots=True)
class Window:
    """Geometry, fixed in the first frame.

    Attributes:
        base: rows and columns of the target at scale 1, in pixels.
        scale: of the first frame: pixels of the frame for one of the window.
        side: of the window, in pixels.
        cell: side of a feature cell, in pixels.
    """

    base: FloatArray
    scale: float
    side: int
    cell: int

    @property
    def cells(self) -> Size:
        """Rows and columns of the feature map."""
        return self.side // self.cell, self.side // self.cell

    @property
    def small(self) -> Size:
        """Rows and columns of the target, in cells."""
        rows, columns = np.minimum(whole(np.floor(self.base / self.cell)), self.cells)
        return int(rows), int(columns)

    def label(self, sigma_factor: float) -> FloatArray:
        """Gaussian label ``(rows, columns)`` with its peak at index 0; its width follows the target's size."""
        return fourier.label(self.cells, math.sqrt(math.prod(self.small)) * sigma_factor)


def fixed_area_window(size: FloatArray, search_area_scale: float, cell: int, filter_max_area: int) -> Window:
    """BACF's window: large targets are shrunk to a fixed number of cells, small ones get smaller cells.

    Args:
        size: rows and columns of the target in the first frame, whole pixels.
        search_area_scale: area of the window in areas of the target is the square of this.
        cell: largest side of a cell in pixels.
        filter_max_area: largest number of cells.
    """
    least = 0.75**2 * filter_max_area
    if math.prod(size / cell * search_area_scale) < least:
        cell = min(cell, max(1, math.ceil(math.sqrt(math.prod(size * search_area_scale) / least))))
    area = math.prod(size / cell * search_area_scale)
    scale = math.sqrt(area / filter_max_area) if area > filter_max_area else 1.0
    base = size / scale
    return Window(base, scale, _multiple(math.sqrt(math.prod(base * search_area_scale)), cell), cell)


def clamped_area_window(size: FloatArray, search_area_scale: float, cell: int, min_area: int, max_area: int) -> Window:
    """STRCF's window: its area in pixels is brought between two limits.

    Args:
        size: rows and columns of the target in the first frame.
        search_area_scale: area of the window in areas of the target is the square of this.
        cell: side of a cell in pixels.
        min_area: smallest area of the window in pixels.
        max_area: largest area of the window in pixels.
    """
    area = math.prod(size * search_area_scale)
    scale = math.sqrt(area / min(max(area, min_area), max_area))
    base = size / scale
    return Window(base, scale, _multiple(math.sqrt(math.prod(base * search_area_scale)), cell), cell)


def _multiple(side: float, cell: int) -> int:
    """The side rounded to a multiple of the cell, at least three cells."""
    return max(int(round_half_away(side / cell)), 3) * cell


def hog_of(grey: bool) -> Features:
    """Feature function of BACF: fHOG, of one channel in a grey sequence."""
    if not grey:
        return lambda patch, cell: fhog(patch, cell, sse=True)
    return lambda patch, cell: fhog(patch[..., 2], cell, sse=True)


def grey_hog_names_of(grey: bool) -> Features:
    """Feature function of STRCF, ARCF-HC and AutoTrack: 42 channels, 32 in a grey sequence."""
    if not grey:
        return grey_hog_names
    return lambda patch, cell: grey_hog_names(patch[..., 2], cell, colour=False)


def spectra(
    frame: Pixels,
    position: ArrayLike,
    scales: Sequence[float],
    window: Window,
    features: Features,
    cosine: NDArray[np.float32],
) -> NDArray[np.complex64]:
    """Spectra of the windowed features about a position at several scales.

    Args:
        frame: ``(H, W)`` or ``(H, W, 3)``, BGR, uint8.
        position: row and column of the centre, 1-based.
        scales: pixels of the frame for one of the window.
        window: geometry.
        features: feature function.
        cosine: ``(rows, columns)``, multiplied with every channel.

    Returns:
        Half spectra ``(S, C, rows, columns // 2 + 1)`` complex64.
    """
    size = (window.side, window.side)
    sizes = round_half_away(np.outer(scales, size))
    patches = (resize_auto(crop(frame, position, n), size) for n in sizes)
    maps = np.stack([features(patch, window.cell) for patch in patches])
    maps *= cosine
    return fourier.rfft2(maps)


def responses(filter_: NDArray[Any], samples: NDArray[Any]) -> NDArray[Any]:
    """Spectra ``(S, rows, columns')`` of the responses of a filter ``(C, …)`` to samples ``(S, C, …)``: ``fᴴz``."""
    return (filter_.conj() * samples).sum(axis=1)

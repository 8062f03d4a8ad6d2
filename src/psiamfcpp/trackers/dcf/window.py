"""The square search window of BACF, STRCF, ARCF-HC and AutoTrack: its geometry, its samples, its responses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from psiamfcpp.geometry import FloatArray
from psiamfcpp.trackers.dcf import fourier
from psiamfcpp.trackers.dcf.features import fhog, grey_hog_names
from psiamfcpp.trackers.dcf.geometry import Pixels, Size, crop, resize_auto, round_half_away, scale_limits, whole

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


@dataclass(frozen=True, slots=True)
class WindowConstants:
    """What the run files of STRCF, ARCF-HC and AutoTrack have in common."""

    cell_size: int = 4
    search_area_scale: float = 5
    """area of the window in areas of the target is the square of this"""
    min_image_sample_size: int = 150**2
    max_image_sample_size: int = 200**2
    output_sigma_factor: float = 1 / 16
    newton_iterations: int = 5

    def window(self, size: FloatArray) -> Window:
        """Window of a target of these rows and columns; its area in pixels is brought between the two limits."""
        area = math.prod(size * self.search_area_scale)
        scale = math.sqrt(area / min(max(area, self.min_image_sample_size), self.max_image_sample_size))
        base = size / scale
        side = math.sqrt(math.prod(base * self.search_area_scale))
        return Window(base, scale, _multiple(side, self.cell_size), self.cell_size)


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


class View:
    """Looks at a frame through a window that follows the target.

    Attributes:
        window: its geometry.
        position: row and column of the target's centre, 1-based; patches are cut about it rounded.
        scale: pixels of the frame for one of the window.
        features: feature function.
    """

    def __init__(self, window: Window, position: FloatArray, features: Features, inner: bool = False):
        self.window, self.position, self.scale, self.features = window, position, window.scale, features
        self._cosine = fourier.hann2(window.cells, inner).astype(np.float32)

    def limits(self, step: float, frame: Pixels) -> tuple[float, float]:
        """Smallest and largest scale, powers of a step; see `scale_limits`."""
        return scale_limits(step, (self.window.side,) * 2, self.window.base, frame.shape[:2])

    def look(self, frame: Pixels, factors: ArrayLike = (1.0,)) -> NDArray[np.complex64]:
        """Half spectra ``(S, C, rows, columns // 2 + 1)`` of the windowed features at multiples of the scale."""
        size = (self.window.side, self.window.side)
        sizes = round_half_away(np.outer(self.scale * np.asarray(factors), size))
        position = round_half_away(self.position)
        patches = (resize_auto(crop(frame, position, n), size) for n in sizes)
        maps = np.stack([self.features(patch, self.window.cell) for patch in patches])
        maps *= self._cosine
        return fourier.rfft2(maps)

    def find(self, filter_: NDArray[Any], samples: NDArray[Any], newton: int) -> tuple[FloatArray, int, NDArray[Any]]:
        """Shift of the target in cells, index of its scale, and the response's half spectrum at that scale.

        Args:
            filter_: half spectrum ``(C, rows, columns')``.
            samples: of `look`.
            newton: iterations that refine the peak.
        """
        spectra = responses(filter_, samples)
        shift, best, _ = fourier.newton_peak(fourier.full_plane(spectra, self.window.cells[1]), newton)
        return shift, best, spectra[best]


def blend(model: NDArray[Any], sample: NDArray[Any], rate: float) -> None:
    """Move a model towards a sample, both in place, with the authors' rounding."""
    model *= np.float32(1 - rate)
    sample *= np.float32(rate)
    model += sample


def neighbours(count: int, step: float) -> FloatArray:
    """Factors of BACF and STRCF about the present scale: ``count`` powers of a step, the small ones first."""
    return step ** (np.arange(count) - (count - 1) // 2).astype(float)


def responses(filter_: NDArray[Any], samples: NDArray[Any]) -> NDArray[Any]:
    """Spectra ``(S, rows, columns')`` of the responses of a filter ``(C, …)`` to samples ``(S, C, …)``: ``fᴴz``."""
    return (filter_.conj() * samples).sum(axis=1)

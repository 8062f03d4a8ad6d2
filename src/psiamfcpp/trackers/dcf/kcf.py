"""KCF: kernelised correlation filter (Henriques, Caseiro, Martins, Batista, TPAMI 2015), with fHOG; no scale."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from psiamfcpp.geometry import Box, FloatArray, Image
from psiamfcpp.trackers.dcf.features import HOG_CHANNELS, Float, fhog, grey
from psiamfcpp.trackers.dcf.fourier import Real, Spectrum, argmax2, hann2, irfft2, label, rfft2
from psiamfcpp.trackers.dcf.geometry import Pixels, Size, crop, cut, position_and_size, to_box

# MATLAB's imresize(., 0.5): bicubic with a = -0.5, stretched by two against aliasing; 256 times its eight weights.
_HALVING = np.array([-3, -9, 29, 111, 111, 29, -9, -3], np.float32)


@dataclass(frozen=True)
class KcfConstants:
    """As the authors' run file names them."""

    padding: float = 1.5
    lambda_: float = 1e-4
    output_sigma_factor: float = 0.1
    interp_factor: float = 0.02
    kernel_sigma: float = 0.5
    cell_size: int = 4
    resize_side: float = 100
    """targets of at least this geometric mean of sides are followed in a frame of half the size"""


class Kcf:
    """The filter; see `KcfConstants`."""

    def __init__(self, frame: Image, box: Box, constants: KcfConstants):
        self._constants = c = constants
        corner, self._size = position_and_size(box)
        self._position, size = corner + np.floor(self._size / 2), self._size
        self._halved = bool(np.sqrt(np.prod(size)) >= c.resize_side)
        if self._halved:
            self._position, size = np.floor(self._position / 2), np.floor(size / 2)
        self._window = np.maximum(np.floor(size * (1 + c.padding)), c.cell_size)
        rows, columns = (self._window // c.cell_size).astype(int)
        self._cells: Size = (int(rows), int(columns))
        sigma = c.output_sigma_factor * np.sqrt(np.prod(size)) / c.cell_size
        self._label = rfft2(label(self._cells, sigma, _offsets).astype(np.float32))
        self._hann = hann2(self._cells).astype(np.float32)
        # Parseval: in the half plane all columns but the first and, at even sizes, the last stand for two.
        self._twice = np.full(columns // 2 + 1, 2, np.float32)
        self._twice[0] = 1
        self._twice[-1] = 1 if columns % 2 == 0 else self._twice[-1]
        self._model = self._sample(frame)
        self._alpha = self._label / (self._kernel(self._model, self._model) + np.float32(c.lambda_))

    def update(self, frame: Image) -> tuple[Box, Real]:
        """See `tracker.Filter`."""
        c = self._constants
        sample = self._sample(frame)
        response = irfft2(self._alpha * self._kernel(sample, self._model), self._cells)
        peak = argmax2(response)
        shift = np.array([i - n if i + 1 > n / 2 else i for i, n in zip(peak, self._cells, strict=True)], np.float64)
        if shift.any():
            self._position = self._position + c.cell_size * shift
            sample = self._sample(frame)
        alpha = self._label / (self._kernel(sample, sample) + np.float32(c.lambda_))
        rate = np.float32(c.interp_factor)
        self._alpha += rate * (alpha - self._alpha)
        self._model += rate * (sample - self._model)
        position: FloatArray = self._position * 2 if self._halved else self._position
        return to_box(position - self._size / 2, self._size), response

    def _sample(self, frame: Image) -> Spectrum:
        patch = _crop_halved(frame, self._position, self._window) if self._halved else None
        if patch is None:
            patch = grey(crop(frame, self._position, self._window))
        features: Float = fhog(patch.astype(np.float32) / np.float32(255), self._constants.cell_size, sse=True)
        features *= self._hann
        return rfft2(features)

    def _kernel(self, x: Spectrum, z: Spectrum) -> Spectrum:
        """Spectrum of the Gaussian kernel of a sample's shifts and another sample (section 6.2)."""
        cells = float(np.prod(self._cells))
        cross = np.einsum("cij,cij->ij", x, z.conj())
        norms = [self._energy(v) / cells for v in ((x,) if x is z else (x, z))]
        distance = norms[0] + norms[-1] - 2 * irfft2(cross, self._cells)
        width = self._constants.kernel_sigma**2 * cells * HOG_CHANNELS
        return rfft2(np.exp(-np.maximum(distance, 0) / np.float32(width)))

    def _energy(self, spectrum: Spectrum) -> np.float32:
        parts = spectrum.view(np.float32).reshape(*spectrum.shape, 2)
        return np.float32(np.einsum("cijk,cijk,j->", parts, parts, self._twice))


def _offsets(n: int) -> FloatArray:
    # for odd n the authors' label reaches one cell further to the right than to the left
    i = np.arange(n, dtype=np.float64)
    return np.where(i <= n - n // 2, i, i - n)


def _crop_halved(frame: Image, position: FloatArray, window: FloatArray) -> Pixels:
    """What `crop` cuts from the grey frame, halved as by MATLAB's imresize; only that part is halved."""
    size = (int(window[0]), int(window[1]))
    first = np.floor(position) - np.floor(window / 2)
    # The border that is replicated is that of the halved frame: halve what lies inside, then replicate.
    limits = (np.array(frame.shape[:2]) + 1) // 2
    low = np.clip(first, 0, limits - 1).astype(int)
    high = np.clip(first + window, low + 1, limits).astype(int)
    # eight taps, from three before pixel 2 i to four behind; beyond the frame's border its mirror image
    (top, left), (bottom, right) = 2 * low - 3, 2 * high + 3
    rows, columns = _mirrored(top, bottom, frame.shape[0]), _mirrored(left, right, frame.shape[1])
    source = grey(np.ascontiguousarray(frame[rows[:, None], columns]))
    for kernel in (_HALVING[:, None], _HALVING[None]):
        source = cv2.filter2D(source, cv2.CV_32F, kernel, anchor=(-1, -1))
        source = source[4:-3:2] if kernel.shape[1] == 1 else source[:, 4:-3:2]
        source = np.clip(np.floor((source + 128) / 256), 0, 255).astype(np.uint8)
    return cut(source, first - low, size)


def _mirrored(first: int, end: int, n: int) -> FloatArray:
    index = np.arange(first, end) % (2 * n)
    return np.where(index < n, index, 2 * n - 1 - index)

"""The two scale filters: DSST's, with 33 scales, and fDSST's, with 17 compressed and interpolated to 33.

Danelljan, Hager, Khan, Felsberg, "Discriminative scale space tracking", TPAMI 2017, sections 3.2 and 4. A sample is a
matrix ``(scales, values)``: the fHOG of a patch at each scale, flattened.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike

from psiamfcpp.geometry import FloatArray, Image
from psiamfcpp.trackers.dcf import resizing
from psiamfcpp.trackers.dcf.features import Float, fhog_many
from psiamfcpp.trackers.dcf.fourier import Spectrum, hann, offsets
from psiamfcpp.trackers.dcf.geometry import Size, clamp_scale, cut, whole

CELL = 4
Limits = tuple[float, float]
"""smallest and largest scale factor"""
NO_LIMITS: Limits = (0.0, math.inf)


def powers(step: float, exponents: ArrayLike) -> FloatArray:
    """Powers of a scale step, each correctly rounded: where a size is whole, the last bit decides its floor."""
    return np.array([math.pow(step, e) for e in np.asarray(exponents)])


def model_size(size: ArrayLike, area: float, smallest: int = CELL) -> Size:
    """Rows and columns that patches are resized to: the target's, but of at most ``area`` pixels.

    A side of less than one cell has no fHOG; the authors' code fails there.
    """
    size = np.asarray(size, np.float64)
    rows, columns = np.floor(size * min(1.0, float(np.sqrt(area / np.prod(size)))))
    return max(int(rows), smallest), max(int(columns), smallest)


def patch_features(image: Image, position: ArrayLike, sizes: FloatArray, model: Size) -> Float:
    """FHOG of patches about one position, ``(n, values)``.

    Args:
        image: ``(H, W, 3)`` uint8, BGR.
        position: row and column, 1-based; floored.
        sizes: ``(n, 2)`` whole rows and columns of the patches.
        model: rows and columns that each is resized to.
    """
    # All patches are views of the largest: outside the frame they replicate the same border.
    centre, half = np.floor(np.asarray(position, np.float64)), np.floor(sizes / 2)
    reach = np.stack([half, sizes - half]).max(axis=1)
    around = cut(image, centre - reach[0], whole(reach.sum(axis=0)))
    patches = np.empty((len(sizes), *model, 3), np.uint8)
    firsts = (reach[0] - half).astype(np.int64)
    resizing.resize_many(np.ascontiguousarray(around), firsts, sizes.astype(np.int64), patches)
    return fhog_many(patches, CELL, sse=True).reshape(len(sizes), -1)


@dataclass(frozen=True)
class ScaleConstants:
    """Of DSST's scale filter, as the authors' run files name them."""

    num_scales: int = 33
    scale_step: float = 1.02
    scale_sigma: float = 33**0.5 / 4
    """in scales"""
    scale_lambda: float = 1e-3
    learning_rate_scale: float = 0.025
    scale_model_max_area: float = 512


# Of ARCF-HC, which AutoTrack took over.
ARCF_SCALES = ScaleConstants(scale_step=1.03, scale_sigma=33**0.5 / 2, scale_lambda=1e-4)


class ScaleFilter:
    """DSST's scale filter (section 3.2), as Staple, MCCT, ARCF and AutoTrack use it.

    Args:
        constants: its constants.
        size: rows and columns of the target at scale factor 1, not rounded.
        limits: of the scale factor.
        model_of: rows and columns that decide the model's size; by default the same.
    """

    def __init__(
        self, constants: ScaleConstants, size: ArrayLike, limits: Limits = NO_LIMITS, model_of: ArrayLike | None = None
    ):
        c = self.constants = constants
        self._size, self._limits = np.asarray(size, np.float64), limits
        self.model = model_size(self._size if model_of is None else model_of, c.scale_model_max_area)
        middle = (c.num_scales + 1) // 2
        steps = np.arange(1, c.num_scales + 1) - middle
        self.factors = powers(c.scale_step, -steps)
        """size of each patch over the target's, the large ones first"""
        self.window = hann(c.num_scales).astype(np.float32)[:, None]
        self.middle = middle - 1
        label = np.exp(-0.5 * steps**2 / c.scale_sigma**2).astype(np.float32)
        self._label = scipy.fft.rfft(label)[:, None]
        self._numerator: Spectrum | None = None
        self._denominator: FloatArray | None = None

    def columns(self, image: Image, position: ArrayLike, scale: float, which: slice = slice(None)) -> Float:
        """Features ``(n, values)`` of some of the scales, not windowed.

        Args:
            image: ``(H, W, 3)`` uint8, BGR.
            position: row and column, 1-based.
            scale: scale factor of the target.
            which: of the factors.
        """
        # The order of the products decides where floor falls: a size may be whole.
        sizes = np.floor(self._size * (scale * self.factors[which, None]))
        return patch_features(image, position, np.maximum(sizes, 2), self.model)

    def follow(self, image: Image, position: ArrayLike, scale: float) -> float:
        """The scale factor of the target about a position (row, column, 1-based), given the one before."""
        best = self.detect(self.columns(image, position, scale) * self.window)
        return self.times(scale, best)

    def times(self, scale: float, index: int) -> float:
        """The scale factor times the factor of this index, within the limits."""
        return clamp_scale(scale * self.factors[index], self._limits)

    def train(self, image: Image, position: ArrayLike, scale: float) -> None:
        """Blend the sample about a position (row, column, 1-based) at a scale factor into the filter."""
        self.blend(self.columns(image, position, scale) * self.window)

    def blend(self, sample: Float) -> None:
        """Blend a windowed sample ``(scales, values)`` into the filter."""
        spectrum = scipy.fft.rfft(sample, axis=0, workers=1)
        numerator = self._label * spectrum.conj()
        denominator = np.square(np.abs(spectrum)).sum(axis=1)
        if self._numerator is None or self._denominator is None:
            self._numerator, self._denominator = numerator, denominator
        else:
            rate = np.float32(self.constants.learning_rate_scale)
            self._numerator += rate * (numerator - self._numerator)
            self._denominator += rate * (denominator - self._denominator)

    def response(self, sample: Float) -> Float:
        """How well a windowed sample fits, by scale ``(scales,)``; the middle stands for no change."""
        assert self._numerator is not None and self._denominator is not None
        spectrum = scipy.fft.rfft(sample, axis=0, workers=1)
        scores = np.einsum("sv,sv->s", self._numerator, spectrum)
        scores /= self._denominator + np.float32(self.constants.scale_lambda)
        return scipy.fft.irfft(scores, n=self.constants.num_scales)

    def detect(self, sample: Float) -> int:
        """Index of the factor that fits a windowed sample best."""
        return int(np.argmax(self.response(sample)))


@dataclass(frozen=True)
class FastScaleConstants:
    """Of fDSST's scale filter, as the authors' run files name them."""

    number_of_scales: int = 17
    number_of_interp_scales: int = 33
    scale_step: float = 1.02
    scale_sigma_factor: float = 1 / 16
    scale_lambda: float = 1e-2
    scale_learning_rate: float = 0.025
    scale_model_max_area: float = 512
    smallest_side: int = CELL
    """of the model, pixels"""
    do_poly_interp: bool = False
    """a parabola about the maximum (ECO)"""
    decimate: bool = False
    """read every n-th pixel of large targets (ECO)"""


class FastScaleFilter:
    """FDSST's scale filter (section 4): 17 scales, compressed to 17 values by QR, interpolated to 33.

    Args:
        constants: its constants.
        size: rows and columns of the target at scale 1.
        limits: of the scale factor.
        model_of: rows and columns that decide the model's size; by default the same.
    """

    def __init__(
        self,
        constants: FastScaleConstants,
        size: ArrayLike,
        limits: Limits = NO_LIMITS,
        model_of: ArrayLike | None = None,
    ):
        c = self.constants = constants
        self._size, self._limits = np.asarray(size, np.float64), limits
        self.model = model_size(self._size if model_of is None else model_of, c.scale_model_max_area, c.smallest_side)
        n, fine = c.number_of_scales, c.number_of_interp_scales
        ring = offsets(n) * fine / n
        self.factors = powers(c.scale_step, np.sort(ring))
        self._fine_factors = powers(c.scale_step, offsets(fine))
        label = np.exp(-0.5 * ring**2 / (fine * c.scale_sigma_factor) ** 2).astype(np.float32)
        self._label = scipy.fft.rfft(label)
        self._window = hann(n).astype(np.float32)
        self._model: Float | None = None

    def _sample(self, image: Image, position: ArrayLike, scale: float) -> Float:
        position, factors = np.asarray(position, np.float64), self.factors * scale
        step = int(np.floor(factors.min())) if self.constants.decimate else 1
        if step > 1:
            image, position, factors = image[::step, ::step], (position - 1) / step + 1, factors / step
        sizes = np.floor(self._size * factors[:, None])
        return patch_features(image, position, np.where(sizes < 1, 2, sizes), self.model)

    def _spectrum(self, compressed: Float) -> Spectrum:
        # compressed: (dimensions, scales)
        return scipy.fft.rfft(compressed * self._window, axis=1, workers=1)

    def train(self, image: Image, position: ArrayLike, scale: float) -> None:
        """Blend the sample about a position (row, column, 1-based) at a scale factor into the filter."""
        sample = self._sample(image, position, scale)
        rate = np.float32(self.constants.scale_learning_rate)
        first = self._model is None
        self._model = sample if self._model is None else self._model + rate * (sample - self._model)
        # The compressed template is the triangle itself: Q'S = R. Signs of its rows cancel in every product.
        self._basis, triangle = np.linalg.qr(self._model.T)
        self._numerator = self._label * self._spectrum(triangle).conj()
        energy = np.square(np.abs(self._spectrum(np.asarray(np.linalg.qr(sample.T, mode="r"))))).sum(axis=0)
        self._denominator: Float = energy if first else self._denominator + rate * (energy - self._denominator)

    def follow(self, image: Image, position: ArrayLike, scale: float) -> float:
        """The scale factor of the target about a position (row, column, 1-based), given the one before."""
        return clamp_scale(scale * self._factor(image, position, scale), self._limits)

    def _factor(self, image: Image, position: ArrayLike, scale: float) -> float:
        c, fine = self.constants, self.constants.number_of_interp_scales
        spectrum = self._spectrum(self._basis.T @ self._sample(image, position, scale).T)
        response = (self._numerator * spectrum).sum(axis=0) / (self._denominator + np.float32(c.scale_lambda))
        # With an odd number of scales the zeros that irfft appends are the finer grid.
        values = scipy.fft.irfft(response * np.float32(fine / c.number_of_scales), n=fine)
        best = int(np.argmax(values))
        if not c.do_poly_interp:
            return float(self._fine_factors[best])
        near = [(best - 1) % fine, best, (best + 1) % fine]
        a, b = parabola(self._fine_factors[near], values[near])
        return float(-b / (2 * a)) if a < 0 else float(self._fine_factors[best])


def parabola(x: FloatArray, y: Float) -> tuple[np.float32, np.float32]:
    """First two coefficients of the parabola ``a x² + b x + c`` through three points.

    As in the authors' code the linear system is solved in single precision, by elimination with row exchanges. It is
    so near singular that rounding moves the vertex by up to a twentieth of a scale step; published boxes depend on it.
    """
    system = np.column_stack([np.vander(x, 3), y]).astype(np.float32)
    for k in range(2):
        pivot = k + int(np.argmax(np.abs(system[k:, k])))
        system[[k, pivot]] = system[[pivot, k]]
        factors = system[k + 1 :, k] * (np.float32(1) / system[k, k])
        system[k + 1 :, k + 1 :] -= np.outer(factors, system[k, k + 1 :])
    c = system[2, 3] / system[2, 2]
    b = (system[1, 3] - system[1, 2] * c) / system[1, 1]
    a = (system[0, 3] - system[0, 2] * c - system[0, 1] * b) / system[0, 0]
    return a, b

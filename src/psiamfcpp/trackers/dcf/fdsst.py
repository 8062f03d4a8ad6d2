"""FDSST: fast discriminative scale space tracking (Danelljan, Hager, Khan, Felsberg, TPAMI 2017)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from psiamfcpp.geometry import Box, Image
from psiamfcpp.trackers.dcf.features import HOG_CHANNELS, Float, cell_means, fhog, grey
from psiamfcpp.trackers.dcf.fourier import (
    Real,
    Spectrum,
    argmax2,
    displacement,
    hann2,
    irfft2,
    irfft2_finer,
    label,
    rfft2,
)
from psiamfcpp.trackers.dcf.geometry import (
    Size,
    crop,
    position_and_size,
    resize_auto,
    round_half_away,
    scale_limits,
    to_box,
    whole,
)
from psiamfcpp.trackers.dcf.scales import FastScaleConstants, FastScaleFilter


@dataclass(frozen=True)
class FdsstConstants:
    """As the authors' run file names them."""

    padding: float = 2.0
    output_sigma_factor: float = 1 / 16
    lambda_: float = 1e-2
    interp_factor: float = 0.025
    num_compressed_dim: int = 18
    feature_ratio: int = 4
    scale: FastScaleConstants = field(default_factory=FastScaleConstants)


class Fdsst:
    """The filter; see `FdsstConstants`."""

    def __init__(self, frame: Image, box: Box, constants: FdsstConstants):
        self._constants = c = constants
        corner, size = position_and_size(box)
        self._position, self._base, self._scale = np.floor(corner + np.floor(size / 2)), np.floor(size), 1.0
        ratio = c.feature_ratio
        self._window = np.maximum(np.floor(self._base * (1 + c.padding)), ratio)
        self._cells: Size = whole(self._window // ratio)
        sigma = np.sqrt(np.prod(np.maximum(np.floor(self._base / ratio), 1))) * c.output_sigma_factor
        self._label = rfft2(label(self._cells, sigma).astype(np.float32))
        self._hann = hann2(self._cells).astype(np.float32)
        limits = scale_limits(c.scale.scale_step, self._window, self._base, frame.shape[:2])
        self._scales = FastScaleFilter(c.scale, self._base, limits)
        self._template: Float | None = None
        self._train(frame)

    def update(self, frame: Image) -> tuple[Box, Real]:
        """See `tracker.Filter`."""
        c = self._constants
        spectrum = self._spectrum(self._sample(frame))
        scores = (self._numerator * spectrum).sum(axis=0) / (self._denominator + np.float32(c.lambda_))
        response = irfft2_finer(scores, self._cells, c.feature_ratio)
        shift = displacement(argmax2(response), response.shape)
        self._position = self._position + round_half_away(shift * self._scale)
        self._scale = self._scales.follow(frame, self._position, self._scale)
        self._train(frame)
        size = np.floor(self._base * self._scale)
        return to_box(self._position - np.floor(size / 2), size), irfft2(scores, self._cells)

    def _train(self, frame: Image) -> None:
        """Blend the sample into the template, compress anew by its principal components, and train the scales."""
        sample, rate = self._sample(frame), np.float32(self._constants.interp_factor)
        first = self._template is None
        if self._template is None:
            self._template = sample.copy()
        else:
            self._template += rate * (sample - self._template)
        _, vectors = np.linalg.eigh((self._template @ self._template.T).astype(np.float64))
        # not centred; the largest first
        self._projection = vectors[:, : -self._constants.num_compressed_dim - 1 : -1].T.astype(np.float32)
        self._numerator = self._label * self._spectrum(self._template).conj()
        energy = np.square(np.abs(self._spectrum(sample))).sum(axis=0)
        self._denominator: Float = energy if first else self._denominator + rate * (energy - self._denominator)
        self._scales.train(frame, self._position, self._scale)

    def _sample(self, frame: Image) -> Float:
        """FHOG and grey of the window, not compressed, not windowed, ``(32, cells)``."""
        ratio = self._constants.feature_ratio
        patch = resize_auto(crop(frame, self._position, self._window * self._scale), whole(self._window))
        out = np.empty((HOG_CHANNELS + 1, *self._cells), np.float32)
        fhog(patch, ratio, out[:HOG_CHANNELS], sse=True)
        out[HOG_CHANNELS] = cell_means(grey(patch), ratio) / np.float32(255) - np.float32(0.5)
        return out.reshape(len(out), -1)

    def _spectrum(self, sample: Float) -> Spectrum:
        compressed = (self._projection @ sample).reshape(-1, *self._cells)
        compressed *= self._hann
        return rfft2(compressed)

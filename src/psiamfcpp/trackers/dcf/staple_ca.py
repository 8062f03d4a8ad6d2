"""Staple-CA: Staple with a filter that learns what surrounds the target (Mueller, Smith, Ghanem, CVPR 2017)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from psiamfcpp.geometry import Box, FloatArray, Image
from psiamfcpp.trackers.dcf import staple
from psiamfcpp.trackers.dcf.features import HOG_CHANNELS, Float, fhog_many
from psiamfcpp.trackers.dcf.fourier import Real, Spectrum, argmax2, hann2, irfft2, rfft2
from psiamfcpp.trackers.dcf.geometry import (
    position_and_size,
    resize_auto,
    round_half_away,
    scale_limits,
    to_box,
    whole,
)
from psiamfcpp.trackers.dcf.scales import ScaleConstants, ScaleFilter

CHANNELS = 28


@dataclass(frozen=True)
class StapleCaConstants:
    """As the authors' params.txt names them."""

    fixed_area: float = 160**2
    inner_padding: float = 0.2
    output_sigma_factor: float = 1 / 16
    lambda_1: float = 1e-3
    lambda_2: float = 0.5
    """weight of the context patches"""
    learning_rate_cf: float = 0.015
    learning_rate_pwp: float = 0.04
    merge_factor: float = 0.2
    """weight of the colours"""
    scale: ScaleConstants = field(default_factory=ScaleConstants)


class StapleCa:
    """The filter; see `StapleCaConstants`."""

    def __init__(self, frame: Image, box: Box, constants: StapleCaConstants):
        self._constants = c = constants
        corner, size = position_and_size(box)
        self._position, self._base, self._scale = corner + size / 2, round_half_away(size), 1.0
        self._rule = staple.Rule(frame.shape[:2], c.fixed_area, 1, c.inner_padding)
        self._areas = self._rule.areas(self._base)
        n = self._normal = staple.Normal.of(self._areas)
        radius = int(np.floor((np.array(n.background) - n.target) / 2).min())
        self._side = 2 * radius + 1
        self._search = n.target + self._side - 1
        height, width = self._base
        self._around = np.array([[0, 0], [-height, 0], [0, -width], [height, 0], [0, width]])
        sigma = np.sqrt(np.prod(n.target)) * c.output_sigma_factor / staple.CELL
        self._label = rfft2(staple.label(n.cells, sigma).astype(np.float32))
        self._hann = hann2(n.cells).astype(np.float32)
        limits = scale_limits(c.scale.scale_step, self._areas.background, self._base, frame.shape[:2])
        self._scales = ScaleFilter(c.scale, self._base, limits, model_of=n.target)
        self._colours = staple.Histograms()
        self._numerator, self._denominator = self._train(frame)

    def update(self, frame: Image) -> tuple[Box, Real]:
        """See `tracker.Filter`."""
        c, n = self._constants, self._normal
        # the target's patch for the filter, a larger one for the colours
        spectrum = self._spectra(frame, self._around[:1])[0][0]
        scores = np.einsum("cij,cij->ij", self._numerator, spectrum) / self._denominator
        response = irfft2(scores, n.cells)
        search = round_half_away(self._search / self._areas.factor)
        likelihood = self._colours.likelihood(staple.patch(frame, self._position, search, whole(self._search)))
        merged = (1 - c.merge_factor) * staple.on_pixels(response, self._side)
        merged += c.merge_factor * staple.centre_likelihood(likelihood, whole(n.target))
        shift = np.array(argmax2(merged)) + 1 - (1 + self._side) / 2
        self._position = self._position + shift / self._areas.factor
        # The authors' boxes have the size before this frame's change of scale.
        size = self._areas.target
        found = to_box(self._position - size / 2, size)
        self._scale = self._scales.follow(frame, self._position, self._scale)
        self._areas = self._rule.areas(self._base * self._scale)
        numerator, denominator = self._train(frame)
        rate = np.float32(c.learning_rate_cf)
        self._numerator += rate * (numerator - self._numerator)
        self._denominator += rate * (denominator - self._denominator)
        return found, response

    def _train(self, frame: Image) -> tuple[Spectrum, Float]:
        """Train colours and scales; numerator and denominator of the filter for this frame (section 3)."""
        c = self._constants
        spectra, patches = self._spectra(frame, self._around)
        self._colours.update(patches[0], self._areas, c.learning_rate_pwp)
        self._scales.train(frame, self._position, self._scale)
        # The denominator is summed over the channels, its regulariser too.
        energy = (np.square(spectra.real) + np.square(spectra.imag)).sum(axis=1)
        denominator = energy[0] + np.float32(c.lambda_2) * energy[1:].sum(axis=0) + np.float32(CHANNELS * c.lambda_1)
        return spectra[0].conj() * self._label, denominator

    def _spectra(self, frame: Image, offsets: FloatArray) -> tuple[Spectrum, Image]:
        """Spectra ``(n, 28, ...)`` of patches at offsets from the position, and the patches."""
        n, area = self._normal, self._areas.background
        patches = np.stack([staple.patch(frame, self._position + o, area, n.background) for o in offsets])
        features = np.empty((len(patches), 1 + HOG_CHANNELS, *n.cells), np.float32)
        for one, patch in zip(features, patches, strict=True):
            one[0] = staple.grey_of_cells(resize_auto(patch, n.cells))
        features[:, 1:] = fhog_many(patches, staple.CELL, sse=True)
        return rfft2(features[:, :CHANNELS] * self._hann), patches

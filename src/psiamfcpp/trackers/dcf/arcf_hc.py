"""ARCF-HC: aberrance-repressed correlation filters (Huang, Fu, Li, Lin, Lu, ICCV 2019), with colour."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.geometry import Box, Image
from psiamfcpp.trackers.dcf import admm, fourier
from psiamfcpp.trackers.dcf.geometry import (
    clamp_scale,
    is_grey,
    position_and_size,
    round_half_away,
    scale_limits,
    to_box,
)
from psiamfcpp.trackers.dcf.scales import ScaleConstants, ScaleFilter
from psiamfcpp.trackers.dcf.window import clamped_area_window, grey_hog_names_of, responses, spectra


@dataclass(frozen=True, slots=True)
class ArcfHcConstants:
    """Constants of the authors' run file; ``mu``, ``beta`` and ``mu_max`` stand in their optimiser."""

    cell_size: int = 4
    search_area_scale: float = 5
    min_image_sample_size: int = 150**2
    max_image_sample_size: int = 200**2
    learning_rate: float = 0.0192
    output_sigma_factor: float = 1 / 16
    newton_iterations: int = 5
    gamma: float = 0.71
    admm_iterations: int = 5
    admm_lambda: float = 0.01
    mu: float = 1
    beta: float = 10
    mu_max: float = 1e4
    scale: ScaleConstants = field(
        default_factory=lambda: ScaleConstants(scale_step=1.03, scale_sigma=math.sqrt(33) / 2, scale_lambda=1e-4)
    )


class ArcfHc:
    """BACF's filter, whose response may change only a little from frame to frame.

    The paper compares responses by their Fourier transforms (eq. 5). The authors' code, which made the published
    boxes, multiplies the previous response in space with the sample's spectrum. That is repeated here. It makes the
    spectra of the filter complex in space, so that full planes are kept.
    """

    def __init__(self, frame: Image, box: Box, constants: ArcfHcConstants):
        self._constants = c = constants
        corner, size = position_and_size(box)
        self._position = corner + (size - 1) / 2
        self._window = w = clamped_area_window(
            size, c.search_area_scale, c.cell_size, c.min_image_sample_size, c.max_image_sample_size
        )
        self._scale = w.scale
        self._limits = scale_limits(c.scale.scale_step, (w.side, w.side), w.base, frame.shape[:2])
        self._features = grey_hog_names_of(is_grey(frame))
        self._cosine = fourier.hann2(w.cells).astype(np.float32)
        self._label = fourier.fft2(w.label(c.output_sigma_factor))
        self._scheme = admm.Scheme(
            admm.penalties(c.mu, c.beta, c.mu_max, c.admm_iterations),
            admm.constrained(admm.rectangle(w.cells, w.small), c.admm_lambda),
            admm.COMPLEX,
        )
        self._model = self._look(frame)
        self._filter = admm.solve(self._model, self._label, self._scheme, w.cells)
        self._remember(self._respond(self._model))
        self._scales = ScaleFilter(c.scale, size)
        self._scales.train(self._scales.sample(frame, self._position, w.base, self._scale))

    def update(self, frame: Image) -> tuple[Box, NDArray[Any]]:
        """The box in the next frame, and the response that it was found in."""
        c, w, scales = self._constants, self._window, self._scales
        plane = self._respond(self._look(frame))
        shift, _, _ = fourier.newton_peak(plane[None], c.newton_iterations)
        self._position = round_half_away(self._position) + shift * w.cell * self._scale
        best = scales.detect(scales.sample(frame, self._position, w.base, self._scale))
        self._scale = clamp_scale(self._scale * scales.factors[best], self._limits)

        before, place = self._response, self._place
        self._remember(plane)
        aligned = np.roll(before, tuple(np.subtract(self._place, place)), axis=(0, 1))
        sample = self._look(frame)
        self._model *= np.float32(1 - c.learning_rate)
        sample *= np.float32(c.learning_rate)
        self._model += sample
        self._filter = admm.solve(self._model, self._label, self._scheme, w.cells, echo=(aligned, c.gamma))
        scales.train(scales.sample(frame, self._position, w.base, self._scale))

        size = w.base * self._scale
        return to_box(round_half_away(self._position - (size - 1) / 2), round_half_away(size)), self._response

    def _respond(self, sample: NDArray[Any]) -> NDArray[Any]:
        """Full plane ``(rows, columns)`` of the response to a sample."""
        return responses(self._filter, sample[None])[0]

    def _remember(self, plane: NDArray[Any]) -> None:
        """Keep a response, zero shift in its middle, and the place of its maximum."""
        self._response = np.fft.fftshift(fourier.irfft2(plane, self._window.cells))
        self._place = fourier.argmax2(self._response)

    def _look(self, frame: Image) -> NDArray[np.complex64]:
        """Full spectra ``(C, rows, columns)`` about the rounded position."""
        position = round_half_away(self._position)
        half = spectra(frame, position, [self._scale], self._window, self._features, self._cosine)[0]
        return fourier.full_plane(half, self._window.cells[1])

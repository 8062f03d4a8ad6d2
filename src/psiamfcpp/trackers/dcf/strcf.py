"""STRCF: spatial-temporal regularised correlation filters (Li, Tian, Zuo, Zhang, Yang, CVPR 2018)."""

from __future__ import annotations

from dataclasses import dataclass
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
from psiamfcpp.trackers.dcf.window import clamped_area_window, grey_hog_names_of, responses, spectra


@dataclass(frozen=True, slots=True)
class StrcfConstants:
    """Constants of the authors' run file."""

    cell_size: int = 4
    search_area_scale: float = 5
    min_image_sample_size: int = 150**2
    max_image_sample_size: int = 200**2
    output_sigma_factor: float = 1 / 16
    newton_iterations: int = 5
    number_of_scales: int = 5
    scale_step: float = 1.01
    temporal_regularization_factor: float = 15
    max_iterations: int = 2
    init_penalty_factor: float = 1
    penalty_scale_step: float = 10
    max_penalty_factor: float = 0.1
    reg_window_min: float = 1e-3
    reg_window_max: float = 1e5


class Strcf:
    """Filter on grey, fHOG and colour names, trained on each frame alone and held near the one before; five scales."""

    def __init__(self, frame: Image, box: Box, constants: StrcfConstants):
        self._constants = c = constants
        corner, size = position_and_size(box)
        self._position = corner + (size - 1) / 2
        self._window = w = clamped_area_window(
            size, c.search_area_scale, c.cell_size, c.min_image_sample_size, c.max_image_sample_size
        )
        self._scale = w.scale
        self._limits = scale_limits(c.scale_step, (w.side, w.side), w.base, frame.shape[:2])
        steps = np.arange(c.number_of_scales) - (c.number_of_scales - 1) // 2
        self._factors = c.scale_step ** steps.astype(float)

        self._features = grey_hog_names_of(is_grey(frame))
        self._cosine = fourier.hann2(w.cells).astype(np.float32)
        self._label = fourier.rfft2(w.label(c.output_sigma_factor))
        inside = admm.rectangle(w.cells, w.small)
        squared = np.where(inside, c.reg_window_min, c.reg_window_max) ** 2
        self._scheme = admm.Scheme(
            admm.penalties(c.init_penalty_factor, c.penalty_scale_step, c.max_penalty_factor, c.max_iterations),
            lambda penalty: (1 / (squared + penalty)).astype(np.float32),
        )
        sample = self._look(frame, [self._scale])[0]
        self._filter = admm.solve(sample, self._label, self._scheme, w.cells)

    def update(self, frame: Image) -> tuple[Box, NDArray[Any]]:
        """The box in the next frame, and the response that it was found in."""
        c, w = self._constants, self._window
        samples = self._look(frame, self._scale * self._factors)
        response = responses(self._filter, samples)
        planes = fourier.full_plane(response, w.cells[1])
        shift, best, _ = fourier.newton_peak(planes, c.newton_iterations)
        found = self._scale * self._factors[best]
        self._position = round_half_away(self._position) + shift * w.cell * found
        self._scale = clamp_scale(found, self._limits)

        sample = self._look(frame, [self._scale])[0]
        temporal = admm.Temporal(self._filter, lambda _: c.temporal_regularization_factor)
        self._filter = admm.solve(sample, self._label, self._scheme, w.cells, temporal)

        size = w.base * self._scale
        box = to_box(round_half_away(self._position - (size - 1) / 2), round_half_away(size))
        return box, fourier.irfft2(response[best], w.cells)

    def _look(self, frame: Image, scales: Any) -> NDArray[np.complex64]:
        return spectra(frame, round_half_away(self._position), scales, self._window, self._features, self._cosine)

"""BACF: background-aware correlation filters (Kiani Galoogahi, Fagg, Lucey, ICCV 2017)."""

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
from psiamfcpp.trackers.dcf.window import fixed_area_window, hog_of, responses, spectra


@dataclass(frozen=True, slots=True)
class BacfConstants:
    """Constants of the authors' run file; ``mu``, ``beta`` and ``mu_max`` stand in their optimiser."""

    hog_cell_size: int = 4
    search_area_scale: float = 5
    filter_max_area: int = 50**2
    learning_rate: float = 0.013
    output_sigma_factor: float = 1 / 16
    newton_iterations: int = 50
    number_of_scales: int = 5
    scale_step: float = 1.01
    admm_iterations: int = 2
    admm_lambda: float = 0.01
    mu: float = 1
    beta: float = 10
    mu_max: float = 1e4


class Bacf:
    """Filter on fHOG, trained on the whole window but zero outside the target; five scales."""

    def __init__(self, frame: Image, box: Box, constants: BacfConstants):
        self._constants = c = constants
        corner, size = position_and_size(box)
        size = np.maximum(np.floor(size), 1)
        self._position = np.floor(corner + np.floor(size / 2))
        self._window = w = fixed_area_window(size, c.search_area_scale, c.hog_cell_size, c.filter_max_area)
        self._scale = w.scale
        window_size = (w.side, w.side)
        self._limits = scale_limits(c.scale_step, window_size, w.base, frame.shape[:2])
        steps = np.arange(c.number_of_scales) - (c.number_of_scales - 1) // 2
        self._factors = c.scale_step ** steps.astype(float)

        self._features = hog_of(is_grey(frame))
        self._cosine = fourier.hann2(w.cells).astype(np.float32)
        self._label = fourier.rfft2(w.label(c.output_sigma_factor))
        self._scheme = admm.Scheme(
            admm.penalties(c.mu, c.beta, c.mu_max, c.admm_iterations),
            admm.constrained(admm.rectangle(w.cells, w.small), c.admm_lambda),
        )
        self._model = self._look(frame, [self._scale])[0]
        self._filter = admm.solve(self._model, self._label, self._scheme, w.cells)

    def update(self, frame: Image) -> tuple[Box, NDArray[Any]]:
        """The box in the next frame, and the response that it was found in."""
        c, w = self._constants, self._window
        samples = self._look(frame, self._scale * self._factors)
        response = responses(self._filter, samples)
        planes = fourier.full_plane(response, w.cells[1])
        shift, best, _ = fourier.newton_peak(planes, c.newton_iterations)
        found = self._scale * self._factors[best]
        self._position = self._position + round_half_away(shift * w.cell * found)
        self._scale = clamp_scale(found, self._limits)

        sample = self._look(frame, [self._scale])[0]
        self._model *= np.float32(1 - c.learning_rate)
        sample *= np.float32(c.learning_rate)
        self._model += sample
        self._filter = admm.solve(self._model, self._label, self._scheme, w.cells)

        size = np.floor(w.base * self._scale)
        return to_box(self._position - np.floor(size / 2), size), fourier.irfft2(response[best], w.cells)

    def _look(self, frame: Image, scales: Any) -> NDArray[np.complex64]:
        return spectra(frame, self._position, scales, self._window, self._features, self._cosine)

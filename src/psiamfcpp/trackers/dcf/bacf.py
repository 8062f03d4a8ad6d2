"""BACF: background-aware correlation filters (Kiani Galoogahi, Fagg, Lucey, ICCV 2017)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.geometry import Box, Image
from psiamfcpp.trackers.dcf import admm, fourier
from psiamfcpp.trackers.dcf.geometry import clamp_scale, floored, is_grey, round_half_away, to_box
from psiamfcpp.trackers.dcf.window import View, blend, fixed_area_window, hog_of, neighbours


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
        position, size = floored(box)
        w = fixed_area_window(size, c.search_area_scale, c.hog_cell_size, c.filter_max_area)
        self._view = View(w, position, hog_of(is_grey(frame)))
        self._limits = self._view.limits(c.scale_step, frame)
        self._factors = neighbours(c.number_of_scales, c.scale_step)
        self._label = fourier.rfft2(w.label(c.output_sigma_factor))
        self._scheme = admm.Scheme(
            admm.penalties(c.mu, c.beta, c.mu_max, c.admm_iterations),
            admm.constrained(admm.rectangle(w.cells, w.small), c.admm_lambda),
        )
        self._model = self._view.look(frame)[0]
        self._filter = admm.solve(self._model, self._label, self._scheme, w.cells)

    def update(self, frame: Image) -> tuple[Box, NDArray[Any]]:
        """The box in the next frame, and the response that it was found in."""
        c, v, w = self._constants, self._view, self._view.window
        shift, best, response = v.find(self._filter, v.look(frame, self._factors), c.newton_iterations)
        found = v.scale * self._factors[best]
        v.position = v.position + round_half_away(shift * w.cell * found)
        v.scale = clamp_scale(found, self._limits)

        blend(self._model, v.look(frame)[0], c.learning_rate)
        self._filter = admm.solve(self._model, self._label, self._scheme, w.cells)

        size = np.floor(w.base * v.scale)
        return to_box(v.position - np.floor(size / 2), size), fourier.irfft2(response, w.cells)

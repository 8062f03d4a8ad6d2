"""STRCF: spatial-temporal regularised correlation filters (Li, Tian, Zuo, Zhang, Yang, CVPR 2018)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.geometry import Box, Image
from psiamfcpp.trackers.dcf import admm, fourier
from psiamfcpp.trackers.dcf.geometry import centred_box, clamp_scale, is_grey, position_and_size, round_half_away
from psiamfcpp.trackers.dcf.window import View, WindowConstants, grey_hog_names_of, neighbours


@dataclass(frozen=True, slots=True)
class StrcfConstants(WindowConstants):
    """Constants of the authors' run file."""

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
        w = c.window(size)
        self._view = View(w, corner + (size - 1) / 2, grey_hog_names_of(is_grey(frame)))
        self._limits = self._view.limits(c.scale_step, frame)
        self._factors = neighbours(c.number_of_scales, c.scale_step)
        self._label = fourier.rfft2(w.label(c.output_sigma_factor))
        squared = np.where(admm.rectangle(w.cells, w.small), c.reg_window_min, c.reg_window_max) ** 2
        self._scheme = admm.Scheme(
            admm.penalties(c.init_penalty_factor, c.penalty_scale_step, c.max_penalty_factor, c.max_iterations),
            lambda penalty: (1 / (squared + penalty)).astype(np.float32),
        )
        self._filter = admm.solve(self._view.look(frame)[0], self._label, self._scheme, w.cells)

    def update(self, frame: Image) -> tuple[Box, NDArray[Any]]:
        """The box in the next frame, and the response that it was found in."""
        c, v, w = self._constants, self._view, self._view.window
        shift, best, response = v.find(self._filter, v.look(frame, self._factors), c.newton_iterations)
        found = v.scale * self._factors[best]
        v.position = round_half_away(v.position) + shift * w.cell * found
        v.scale = clamp_scale(found, self._limits)

        temporal = admm.Temporal(self._filter, lambda _: c.temporal_regularization_factor)
        self._filter = admm.solve(v.look(frame)[0], self._label, self._scheme, w.cells, temporal)
        return centred_box(v.position, w.base * v.scale), fourier.irfft2(response, w.cells)

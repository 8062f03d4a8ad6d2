"""ARCF-HC: aberrance-repressed correlation filters (Huang, Fu, Li, Lin, Lu, ICCV 2019), with colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.geometry import Box, Image
from psiamfcpp.trackers.dcf import admm, fourier
from psiamfcpp.trackers.dcf.geometry import centred_box, is_grey, position_and_size, round_half_away
from psiamfcpp.trackers.dcf.scales import ARCF_SCALES, ScaleConstants, ScaleFilter
from psiamfcpp.trackers.dcf.window import View, WindowConstants, blend, grey_hog_names_of, responses


@dataclass(frozen=True, slots=True)
class ArcfHcConstants(WindowConstants):
    """Constants of the authors' run file; ``mu``, ``beta`` and ``mu_max`` stand in their optimiser."""

    learning_rate: float = 0.0192
    gamma: float = 0.71
    admm_iterations: int = 5
    admm_lambda: float = 0.01
    mu: float = 1
    beta: float = 10
    mu_max: float = 1e4
    scale: ScaleConstants = ARCF_SCALES


class ArcfHc:
    """BACF's filter, whose response may change only a little from frame to frame.

    The paper compares responses by their Fourier transforms (eq. 5). The authors' code, which made the published
    boxes, multiplies the previous response in space with the sample's spectrum. That is repeated here. It makes the
    spectra of the filter complex in space, so that full planes are kept.
    """

    def __init__(self, frame: Image, box: Box, constants: ArcfHcConstants):
        self._constants = c = constants
        corner, size = position_and_size(box)
        w = c.window(size)
        self._view = v = View(w, corner + (size - 1) / 2, grey_hog_names_of(is_grey(frame)))
        self._label = fourier.fft2(w.label(c.output_sigma_factor))
        self._scheme = admm.Scheme(
            admm.penalties(c.mu, c.beta, c.mu_max, c.admm_iterations),
            admm.constrained(admm.rectangle(w.cells, w.small), c.admm_lambda),
            admm.COMPLEX,
        )
        self._model = self._look(frame)
        self._filter = admm.solve(self._model, self._label, self._scheme, w.cells)
        self._remember(self._respond(self._model))
        self._scales = ScaleFilter(c.scale, w.base, v.limits(c.scale.scale_step, frame), model_of=size)
        self._scales.train(frame, v.position, v.scale)

    def update(self, frame: Image) -> tuple[Box, NDArray[Any]]:
        """The box in the next frame, and the response that it was found in."""
        c, v, w = self._constants, self._view, self._view.window
        plane = self._respond(self._look(frame))
        shift, _, _ = fourier.newton_peak(plane[None], c.newton_iterations)
        v.position = round_half_away(v.position) + shift * w.cell * v.scale
        v.scale = self._scales.follow(frame, v.position, v.scale)

        before, place = self._response, self._place
        self._remember(plane)
        aligned = np.roll(before, tuple(np.subtract(self._place, place)), axis=(0, 1))
        blend(self._model, self._look(frame), c.learning_rate)
        self._filter = admm.solve(self._model, self._label, self._scheme, w.cells, echo=(aligned, c.gamma))
        self._scales.train(frame, v.position, v.scale)
        return centred_box(v.position, w.base * v.scale), self._response

    def _respond(self, sample: NDArray[Any]) -> NDArray[Any]:
        """Full plane ``(rows, columns)`` of the response to a sample."""
        return responses(self._filter, sample[None])[0]

    def _remember(self, plane: NDArray[Any]) -> None:
        """Keep a response, zero shift in its middle, and the place of its maximum."""
        self._response = np.fft.fftshift(fourier.irfft2(plane, self._view.window.cells))
        self._place = fourier.argmax2(self._response)

    def _look(self, frame: Image) -> NDArray[np.complex64]:
        """Full spectra ``(C, rows, columns)``."""
        return fourier.full_plane(self._view.look(frame)[0], self._view.window.cells[1])

"""AutoTrack: automatic spatio-temporal regularisation (Li, Fu, Ding, Huang, Lu, CVPR 2020)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.geometry import Box, Image
from psiamfcpp.trackers.dcf import admm, fourier
from psiamfcpp.trackers.dcf.features import Float
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

# The authors' code divides by the old scale window plus this before it multiplies by the new one.
_WINDOW_FLOOR = 1e-5


@dataclass(frozen=True, slots=True)
class AutoTrackConstants:
    """Constants of the authors' run file; those from ``occlusion`` on stand in their functions."""

    cell_size: int = 4
    search_area_scale: float = 5
    min_image_sample_size: int = 150**2
    max_image_sample_size: int = 200**2
    output_sigma_factor: float = 0.06
    newton_iterations: int = 5
    admm_iterations: int = 4
    admm_lambda: float = 1
    zeta: float = 13
    delta: float = 0.2
    nu: float = 0.2
    scale: ScaleConstants = field(
        default_factory=lambda: ScaleConstants(scale_step=1.03, scale_sigma=math.sqrt(33) / 2, scale_lambda=1e-4)
    )
    occlusion: float = 0.3
    reg_window_min: float = 1e-3
    reg_window_max: float = 1e5
    gamma: float = 1
    beta: float = 10
    gamma_max: float = 1e4


class AutoTrack:
    """STRCF's filter whose spatial and temporal weights follow the change of the response between two frames.

    A frame counts as occluded where the response changed by thousands of times its former value. That happens in cells
    where the former value is nearly zero, so rounding decides it. A frame trained or left out moves later boxes by
    about a pixel; boxes equal to the authors' over whole sequences cannot be had.
    """

    def __init__(self, frame: Image, box: Box, constants: AutoTrackConstants):
        self._constants = c = constants
        corner, size = position_and_size(box)
        size = np.maximum(np.floor(size), 1)
        self._position = np.floor(corner + np.floor(size / 2))
        self._window = w = clamped_area_window(
            size, c.search_area_scale, c.cell_size, c.min_image_sample_size, c.max_image_sample_size
        )
        self._scale = w.scale
        self._limits = scale_limits(c.scale.scale_step, (w.side, w.side), w.base, frame.shape[:2])
        self._features = grey_hog_names_of(is_grey(frame))
        self._cosine = fourier.hann2(w.cells, inner=True).astype(np.float32)
        self._label = fourier.rfft2(w.label(c.output_sigma_factor))
        self._inside = admm.rectangle(w.cells, w.small)
        self._weights = np.where(self._inside, c.reg_window_min, c.reg_window_max)
        self._penalties = admm.penalties(c.gamma, c.beta, c.gamma_max, c.admm_iterations)

        sample = spectra(frame, self._position, [self._scale], w, self._features, self._cosine)[0]
        self._filter = admm.solve(sample, self._label, self._scheme(), w.cells)
        self._settled: NDArray[Any] | None = None
        """the response of the frame before, with its peak rolled to index 0"""
        self._scales = ScaleFilter(c.scale, size)
        self._scales.train(self._scales.sample(frame, self._position, w.base, self._scale))

    def update(self, frame: Image) -> tuple[Box, NDArray[Any]]:
        """The box in the next frame, and the response that it was found in."""
        c, w = self._constants, self._window
        sample = spectra(frame, self._position, [self._scale], w, self._features, self._cosine)[0]
        spectrum = responses(self._filter, sample[None])
        shift, _, _ = fourier.newton_peak(fourier.full_plane(spectrum, w.cells[1]), c.newton_iterations)
        moved = round_half_away(shift * w.cell * self._scale)
        self._position = self._position + moved
        self._follow_scale(frame)

        response = fourier.irfft2(spectrum[0], w.cells)
        theta = self._regularise(np.roll(response, tuple(-np.floor(shift).astype(int)), axis=(0, 1)))
        if theta is not None:
            turn = fourier.phase_shift(w.cells, 2 * np.pi * moved / (self._scale * w.side))
            sample *= turn[:, : sample.shape[-1]].astype(np.complex64)
            self._filter = admm.solve(sample, self._label, self._scheme(), w.cells, self._temporal(theta))

        size = round_half_away(w.base * self._scale)
        return to_box(self._position - size / 2, size), response

    def _scheme(self) -> admm.Scheme:
        count = self._weights.size
        squared = self._constants.admm_lambda * self._weights**2
        return admm.Scheme(
            self._penalties, lambda g: (count / (squared + g * count)).astype(np.float32), scaled_multiplier=True
        )

    def _regularise(self, settled: NDArray[Any]) -> float | None:
        """Set the spatial weights by the change of the response (section 3.2).

        Returns:
            The reference ``theta`` of the temporal weight, or None where the target seems occluded.
        """
        c, before, self._settled = self._constants, self._settled, settled
        if before is None:
            return c.zeta
        change = np.abs(np.abs(settled - before) / np.where(before == 0, np.finfo(np.float32).tiny, before))
        change = np.minimum(change.astype(np.float64), 1e30)
        eta = float(np.linalg.norm(change, 2)) / 1e4
        rolled = np.roll(change, tuple(n // 2 for n in change.shape), axis=(0, 1))
        self._weights = np.where(self._inside, c.delta * np.log(rolled + 1), c.reg_window_max)
        return c.zeta / (1 + math.log(c.nu * eta + 1)) if eta < c.occlusion else None

    def _temporal(self, theta: float) -> admm.Temporal:
        """The pull towards the last filter: ``zeta`` in the first iteration, then ``theta`` less the change so far."""
        before = self._filter
        # The authors' code reads the change of one coefficient: column by column the one with the channels' number.
        column, row = divmod(len(before) - 1, before.shape[1])

        def pull(f: NDArray[Any] | None) -> float:
            if f is None or theta == self._constants.zeta:
                return self._constants.zeta
            return theta - float(abs(f[0, row, column] - before[0, row, column]) ** 2) / 2

        return admm.Temporal(before, pull)

    def _follow_scale(self, frame: Image) -> None:
        """Find the scale at the new position and train its filter on the same patches, moved to the new scale."""
        scales = self._scales
        columns = scales.columns(frame, self._position, self._window.base, scale=self._scale)
        best = scales.detect(columns * scales.window)
        self._scale = clamp_scale(self._scale * scales.factors[best], self._limits)
        scales.train(self._moved(columns, best - scales.middle, frame) * scales.window)

    def _moved(self, columns: Float, steps: int, frame: Image) -> Float:
        """Columns of the detection at the new scale: ``steps`` further on, and fresh ones where there were none."""
        if steps == 0:
            return columns
        scales = self._scales
        columns = columns * (scales.window / (scales.window + np.float32(_WINDOW_FLOOR)))
        fresh = slice(-steps, None) if steps > 0 else slice(None, -steps)
        moved = np.roll(columns, -steps, axis=0)
        moved[fresh] = scales.columns(frame, self._position, self._window.base, fresh, self._scale)
        return moved

"""MCCT-H: seven filters on three features, of which the most reliable leads (Wang et al., CVPR 2018)."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from psiamfcpp.geometry import Box, FloatArray, Image, overlap
from psiamfcpp.trackers.dcf import staple
from psiamfcpp.trackers.dcf.features import NAME_CHANNELS, Float, colour_names, fhog
from psiamfcpp.trackers.dcf.fourier import Real, Spectrum, argmax2, hann2, irfft2, rfft2
from psiamfcpp.trackers.dcf.geometry import (
    Pixels,
    position_and_size,
    resize_auto,
    round_half_away,
    scale_limits,
    to_box,
)
from psiamfcpp.trackers.dcf.scales import ScaleConstants, ScaleFilter

# Blocks of channels: colour names; grey and fHOG 1-15; fHOG 16-31.
BLOCKS = (slice(0, 10), slice(10, 26), slice(26, 42))
# Which blocks each expert sees.
EXPERTS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, 1], [0, 1, 1], [1, 1, 1]], np.float32)


@dataclass(frozen=True)
class McctHConstants:
    """As the authors' code names them."""

    fixed_area: float = 150**2
    inner_padding: float = 0.2
    padding: float = 1.5
    padding_large: float = 1.0
    large: float = 0.05
    """share of the frame above which a target is padded as a large one"""
    output_sigma_factor: float = 0.1
    lambda_: float = 1e-4
    learning_rate_cf: float = 0.01
    learning_rate_pwp: float = 0.01
    period: int = 5
    """frames that reliability is judged over"""
    expert_num: int = 7
    update_thres: float = 0.6
    scale: ScaleConstants = field(default_factory=lambda: ScaleConstants(scale_sigma=33**0.5 / 2, scale_lambda=1e-4))


class McctH:
    """The filters; see `McctHConstants`."""

    def __init__(self, frame: Image, box: Box, constants: McctHConstants):
        self._constants = c = constants
        corner, size = position_and_size(box)
        # The authors' code needs whole sizes, which their labels have.
        self._position, self._base, self._scale = corner + np.floor(size / 2), round_half_away(size), 1.0
        padding = c.padding_large if np.prod(size) > c.large * np.prod(frame.shape[:2]) else c.padding
        self._rule = staple.Rule(frame.shape[:2], c.fixed_area, padding, c.inner_padding)
        self._areas = self._rule.areas(self._base)
        n = self._normal = staple.Normal.of(self._areas)
        self._side = min(n.background)
        sigma = np.sqrt(np.prod(n.target)) * c.output_sigma_factor / staple.CELL
        self._label = rfft2(staple.label(n.cells, sigma).astype(np.float32)).conj()
        self._hann = hann2(n.cells).astype(np.float32)
        limits = scale_limits(c.scale.scale_step, self._areas.background, self._base, frame.shape[:2])
        self._scales = ScaleFilter(c.scale, self._base, limits, model_of=n.target)
        self._colours = staple.Histograms()
        start = np.tile(to_box(self._position - self._base / 2, self._base), (len(EXPERTS), 1))
        self._boxes, self._smooth = [start], [np.ones(len(EXPERTS))]
        self._reliability: list[float] = []
        self._frames = 1
        area = self._areas.background
        self._colours.update(staple.patch(frame, self._position, area, n.background), self._areas, 1.0)
        self._numerator, self._denominator = self._train(frame)

    def update(self, frame: Image) -> tuple[Box, Real]:
        """See `tracker.Filter`."""
        c, n = self._constants, self._normal
        self._frames += 1
        patch = staple.patch(frame, self._position, self._areas.background, n.background)
        spectrum = rfft2(self._features(patch) * (self._hann * self._likelihood(patch)))
        blocks = np.stack([np.einsum("cij,cij->ij", self._numerator[b], spectrum[b]) for b in BLOCKS])
        scores = np.tensordot(EXPERTS, blocks, 1) / (np.tensordot(EXPERTS, self._denominator, 1) + c.lambda_)
        responses = staple.on_pixels(irfft2(scores, n.cells), self._side)
        shifts = np.array([argmax2(r) for r in responses]) + 1 - (1 + self._side) / 2
        positions = self._position + shifts / self._areas.factor
        size = self._areas.target
        self._remember(np.array([to_box(p - size / 2, size) for p in positions]), float(size.mean()))
        best, filter_rate, colour_rate = self._judge(responses)
        self._position = positions[best]
        self._scale = self._scales.follow(frame, self._position, self._scale)
        self._areas = self._rule.areas(self._base * self._scale)
        area = 0.8 * self._areas.background
        self._colours.update(staple.patch(frame, self._position, area, n.background), self._areas, colour_rate)
        numerator, denominator = self._train(frame)
        self._numerator += np.float32(filter_rate) * (numerator - self._numerator)
        self._denominator += np.float32(filter_rate) * (denominator - self._denominator)
        # The authors' boxes have the size before this frame's change of scale.
        return to_box(self._position - size / 2, size), responses[best]

    def _features(self, patch: Pixels) -> Float:
        out = np.empty((BLOCKS[-1].stop, *self._normal.cells), np.float32)
        resized = resize_auto(patch, self._normal.cells)
        colour_names(resized, 1, out[:NAME_CHANNELS])
        out[NAME_CHANNELS] = staple.grey_of_cells(resized)
        fhog(patch, staple.CELL, out[NAME_CHANNELS + 1 :], sse=True)
        return out

    def _likelihood(self, patch: Pixels) -> Float:
        """Window for detection: where the colours are those of the target (section 3.1)."""
        rows, columns = self._normal.cells
        cells = cv2.resize(self._colours.likelihood(patch), (columns, rows), interpolation=cv2.INTER_AREA)
        total = cells.max() + cells.min()
        cells = (cells + cells.min()) / total if total > 0 else np.zeros_like(cells)
        if total > 0 and cells.mean() < 0.01:
            cells[:] = 1
        return np.maximum(cells, np.float32(0.1))

    def _train(self, frame: Image) -> tuple[Spectrum, Real]:
        """Train the scales; conjugate numerators, and denominators of the three blocks, for this frame."""
        n = self._normal
        patch = staple.patch(frame, self._position, self._areas.background, n.background)
        spectrum = rfft2(self._features(patch) * self._hann)
        cells = np.float32(n.cells[0] * n.cells[1])
        energy = np.square(spectrum.real) + np.square(spectrum.imag)
        self._scales.train(frame, self._position, self._scale)
        denominators = np.stack([energy[b].sum(axis=0) for b in BLOCKS])
        return (self._label * spectrum).conj() / cells, denominators / cells

    def _remember(self, boxes: FloatArray, mean_side: float) -> None:
        """Keep the experts' boxes ``(7, 4)`` and how smoothly each moved (section 3.3)."""
        # Frame 1 has no centre in the authors' code: its zero makes the way to frame 2 long.
        middles = boxes[:, :2] + boxes[:, 2:] / 2
        before = self._boxes[-1][:, :2] + self._boxes[-1][:, 2:] / 2 if self._frames > 2 else 0
        way = np.square(middles - before).sum(axis=1)
        keep = self._constants.period - 1
        self._boxes = [*self._boxes[-keep:], boxes]
        self._smooth = [*self._smooth[-keep:], np.exp(-way / (2 * mean_side**2))]

    def _judge(self, responses: Real) -> tuple[int, float, float]:
        """The expert to follow, and the learning rates of filters and colours (sections 3.3 and 3.4)."""
        c = self._constants
        if self._frames < c.period:
            return len(EXPERTS) - 1, c.learning_rate_cf, c.learning_rate_pwp
        boxes, smooth = np.array(self._boxes), np.array(self._smooth)
        weight = 1.1 ** np.arange(c.period)
        weight /= weight.sum()
        agreement = np.exp(-np.square(1 - overlap(boxes[:, :, None], boxes[:, None])))
        spread = np.sqrt(np.square(agreement - agreement.mean(axis=0)).mean(axis=2))
        pair = (weight @ agreement.mean(axis=2)) / (weight @ spread + 0.008)
        scores = 0.1 * pair + 0.9 * (weight @ smooth)
        single = responses[:3].reshape(3, -1)
        deviation = np.maximum(single.std(axis=1, ddof=1), 1e-12)
        sharpness = float(((single.max(axis=1) - single.mean(axis=1)) / deviation).mean())
        self._reliability.append(float(scores.mean()) * sharpness)
        now, threshold = self._reliability[-1], c.update_thres * float(np.mean(self._reliability))
        if now > threshold:
            return int(np.argmax(scores)), c.learning_rate_cf, c.learning_rate_pwp
        rate = (now / threshold) ** 3 * c.learning_rate_cf if threshold > 0 else 0.0
        return int(np.argmax(scores)), rate, 0.0

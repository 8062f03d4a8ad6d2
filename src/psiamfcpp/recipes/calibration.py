"""Fit the confidence of a tracker, and the limits of its states, on clips that it was not trained on."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from psiamfcpp.datasets import Sequence
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import FloatArray, Image, centre, from_centre, overlap, to_centre
from psiamfcpp.spec import Calibration
from psiamfcpp.trackers.siamfcpp import Tracker
from psiamfcpp.trackers.siamfcpp.confidence import confidence
from psiamfcpp.trackers.siamfcpp.procedure import Target

# Unsure is what is more likely wrong than right; doubted, what is wrong at odds of ninety-nine to one, since clips to
# calibrate on are easier than flights: at nineteen to one, targets that were followed correctly in flight were lost.
UNSURE_BELOW, LOST_BELOW = 0.5, 0.01
# Of single frames without the target, the share that may be taken for it when a lost one is looked for.
FALSE_REGAIN_SHARE = 0.005
_FOUND_OVERLAP = 0.4
_FRAMES_A_CLIP = 16
_SMALLEST_SIDE = 1.0


@dataclass(frozen=True)
class Looks:
    """What single search regions said, one row each."""

    peak: FloatArray
    """``(n,)``: score of the chosen cell"""
    contrast: FloatArray
    """``(n,)``: see `psiamfcpp.trackers.siamfcpp.procedure.contrast`"""
    found: NDArray[np.bool_]
    """``(n,)``: the target was there, and the box lay on it"""
    absent: NDArray[np.bool_]
    """``(n,)``: the target was not there"""
    clip: NDArray[np.intp]
    """``(n,)``: number of the clip"""


@dataclass(frozen=True)
class Rates:
    """How well the limits do on clips that they were not fitted on (two halves, each judging the other)."""

    hit: float
    """share of single frames without the target whose confidence is under ``lost_below``"""
    false_alarm: float
    """share of single frames with the target found whose confidence is under ``lost_below``"""
    unsure: float
    """share of single frames with the target found whose confidence is under ``unsure_below``"""
    false_regain: float
    """share of single frames without the target whose confidence reaches ``regain_above``"""
    regain: float
    """share of single frames with the target found whose confidence reaches ``regain_above``"""
    clips: int
    found_frames: int
    absent_frames: int


def gather(tracker: Tracker, sequences: list[Sequence], seed: int = 0) -> Looks:
    """Look at frames of clips with the target where it moved to, and at the same frames without it.

    Without it means: the target covered by another patch of its frame, a place elsewhere in its frame, and a frame
    of another clip.

    Raises:
        UserError: there are fewer than two clips, or none with two labelled frames.
    """
    if len(sequences) < 2:
        raise UserError(f"calibration needs at least two clips, {len(sequences)} given")
    rng = np.random.default_rng(seed)
    rows: list[tuple[float, float, bool, bool, int]] = []
    for number, sequence in enumerate(sequences):
        other = sequences[(number + 1 + int(rng.integers(len(sequences) - 1))) % len(sequences)]
        frames = sequence.usable(_SMALLEST_SIDE)
        if len(frames) < 2:
            continue
        tracker.init(sequence.frame(frames[0]), sequence.boxes[frames[0]])
        picks = np.unique(np.linspace(1, len(frames) - 1, _FRAMES_A_CLIP).astype(int))
        for pick in picks:
            image, box = sequence.frame(frames[pick]), sequence.boxes[frames[pick]]
            before = Target(*to_centre(sequence.boxes[frames[pick - 1]]))
            found, apart = tracker.look(image, before)
            t = found.target
            hit = bool(overlap(from_centre(t.cx, t.cy, t.w, t.h), box) >= _FOUND_OVERLAP)
            rows.append((found.score, apart, hit, False, number))
            for scene, around in _without(image, box, other.frame(int(rng.integers(len(other)))), rng):
                found, apart = tracker.look(scene, around)
                rows.append((found.score, apart, False, True, number))
    if not rows:
        raise UserError(f"calibration needs clips with labels; none of {len(sequences)} has two labelled frames")
    peak, contrast, hits, absent, clip = (np.array(column) for column in zip(*rows, strict=True))
    return Looks(peak, contrast, hits, absent, clip)


def fit(looks: Looks) -> Calibration:
    """Weights by logistic regression on found against absent, then the limits above.

    Raises:
        UserError: one of the two kinds is missing.
    """
    use = looks.found | looks.absent
    if not looks.found.any() or not looks.absent.any():
        raise UserError("calibration found no frame with, or none without, its target: the model finds nothing")
    peak = np.clip(looks.peak, 1e-4, 1 - 1e-4)
    features = np.column_stack([np.ones_like(peak), np.log(peak / (1 - peak)), looks.contrast])[use]
    labels = looks.found[use].astype(float)
    # Both kinds weigh the same: how often targets vanish is not known.
    weights = np.where(labels > 0, 0.5 / labels.sum(), 0.5 / (1 - labels).sum()) * len(labels)
    bias, score_weight, contrast_weight = _logistic(features, labels, weights)
    calibration = Calibration(bias, score_weight, contrast_weight, UNSURE_BELOW, LOST_BELOW)
    absent = confidences(looks, calibration)[looks.absent]
    # Where both kinds lie far apart, what would be doubted at once must still not be re-acquired.
    regain = max(UNSURE_BELOW, float(np.quantile(absent, 1 - FALSE_REGAIN_SHARE)))
    return dataclasses.replace(calibration, regain_above=regain)


def cross_rates(looks: Looks) -> Rates:
    """Rates of limits fitted on the even clips and judged on the odd ones, and the other way round."""
    parts = [looks.clip % 2 == side for side in (0, 1)]
    counts: Counter[str] = Counter()
    for own, other in (parts, parts[::-1]):
        limits, judged = fit(_rows(looks, own)), _rows(looks, other)
        values = confidences(judged, limits)
        found, absent = values[judged.found], values[judged.absent]
        counts["hit"] += int((absent < limits.lost_below).sum())
        counts["false_alarm"] += int((found < limits.lost_below).sum())
        counts["unsure"] += int((found < limits.unsure_below).sum())
        counts["false_regain"] += int((absent >= limits.regain_above).sum())
        counts["regain"] += int((found >= limits.regain_above).sum())
    with_target, without = int(looks.found.sum()), int(looks.absent.sum())
    return Rates(
        hit=counts["hit"] / without,
        false_alarm=counts["false_alarm"] / with_target,
        unsure=counts["unsure"] / with_target,
        false_regain=counts["false_regain"] / without,
        regain=counts["regain"] / with_target,
        clips=len(np.unique(looks.clip)),
        found_frames=with_target,
        absent_frames=without,
    )


def confidences(looks: Looks, calibration: Calibration) -> FloatArray:
    """The confidence ``(n,)`` of each look."""
    return np.array([confidence(p, c, calibration) for p, c in zip(looks.peak, looks.contrast, strict=True)])


def _rows(looks: Looks, rows: NDArray[np.bool_]) -> Looks:
    return Looks(looks.peak[rows], looks.contrast[rows], looks.found[rows], looks.absent[rows], looks.clip[rows])


def _without(image: Image, box: FloatArray, other: Image, rng: Generator) -> Iterator[tuple[Image, Target]]:
    """Scenes like the target's without the target, and where to look in them."""
    target = Target(*to_centre(box))
    covered = _covered(image, box, rng)
    if covered is not None:
        yield covered, target
    reach = 3.0 * max(target.w, target.h)
    for _ in range(20):
        cx, cy = _somewhere(image, rng)
        if max(abs(cx - target.cx), abs(cy - target.cy)) > reach:
            yield image, Target(cx, cy, target.w, target.h)
            break
    cx, cy = _somewhere(other, rng)
    yield other, Target(cx, cy, target.w, target.h)


def _covered(image: Image, box: FloatArray, rng: Generator) -> Image | None:
    """A copy with the target and its rim under another patch of the frame; None where there is no room for one."""
    height, width = image.shape[:2]
    cx, cy = centre(box)
    w, h = (max(4, int(v * 1.3)) for v in box[2:])
    if 2 * w > width or 2 * h > height:
        return None
    x, y = int(np.clip(cx - w / 2, 0, width - w)), int(np.clip(cy - h / 2, 0, height - h))
    for _ in range(20):
        sx, sy = int(rng.integers(0, width - w + 1)), int(rng.integers(0, height - h + 1))
        if abs(sx - x) >= w or abs(sy - y) >= h:
            copy = image.copy()
            copy[y : y + h, x : x + w] = image[sy : sy + h, sx : sx + w]
            return copy
    return None


def _somewhere(image: Image, rng: Generator) -> tuple[float, float]:
    height, width = image.shape[:2]
    return float(rng.uniform(0.1, 0.9) * width), float(rng.uniform(0.1, 0.9) * height)


def _logistic(features: FloatArray, labels: FloatArray, weights: FloatArray) -> tuple[float, float, float]:
    """Newton's method on the weighted log-likelihood, with a small ridge that keeps separable data finite."""
    beta = np.zeros(features.shape[1])
    ridge = 1e-2 * np.eye(len(beta))
    for _ in range(50):
        p = 1 / (1 + np.exp(-np.clip(features @ beta, -30, 30)))
        gradient = features.T @ (weights * (labels - p)) - ridge @ beta
        hessian = (features * (weights * p * (1 - p))[:, None]).T @ features + ridge
        step = np.linalg.solve(hessian, gradient)
        beta += step
        if np.abs(step).max() < 1e-8:
            break
    return float(beta[0]), float(beta[1]), float(beta[2])

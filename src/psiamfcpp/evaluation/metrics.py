"""One-pass evaluation: precision, success and their conventions (Wu et al. 2013, and what toolkits made of it).

Two conventions are in use for frames without a valid label (docs/evaluation.md):

* ``otb``, of the DCF toolkits and pysot: a row is valid if all four numbers are above 0; an invalid row counts as a
  precision hit and as an overlap miss.
* ``got10k``: a row with a NaN is dropped; every other row counts.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import FloatArray, centre, centre_error, overlap

Convention = Literal["otb", "got10k"]

PRECISION_THRESHOLDS = np.arange(51.0)
NORMALIZED_THRESHOLDS = np.arange(51) / 100
OVERLAP_THRESHOLDS = np.arange(21) / 20


@dataclass(frozen=True)
class Scores:
    """Curves of one sequence, or their mean; all shares lie in 0..1."""

    precision_curve: FloatArray
    """``(51,)``: share of frames with a centre error of at most 0, 1, ... 50 pixels"""
    normalized_curve: FloatArray
    """``(51,)``: the same with the error divided by the target's width and height, up to 0, 0.01, ... 0.5"""
    success_curve: FloatArray
    """``(21,)``: share of frames with an overlap above 0, 0.05, ... 1"""
    frames: int
    """rows that count"""
    invalid: int
    """rows without a valid label"""

    @property
    def figures(self) -> dict[str, float]:
        """The four figures that papers print."""
        return {
            "precision": float(self.precision_curve[20]),
            "normalized_precision": float(self.normalized_curve[20]),
            "auc": float(self.success_curve.mean()),
            "success50": float(self.success_curve[10]),
        }


def score_sequence(truth: ArrayLike, result: ArrayLike, convention: Convention = "otb") -> Scores:
    """Score one sequence.

    The first result box is replaced by the label; a result box that is not finite or has no area repeats the one
    before it.

    Args:
        truth: labels ``(n, 4)`` as ``(x, y, w, h)``; rows may be NaN or zero.
        result: boxes ``(n, 4)`` of the tracker.
        convention: what a row without a valid label counts for.

    Raises:
        UserError: the numbers of rows differ, or no row counts.
    """
    truth, boxes = np.asarray(truth, np.float64), np.array(result, np.float64)
    if truth.shape != boxes.shape or truth.ndim != 2 or truth.shape[1] != 4:
        raise UserError(f"results have shape {boxes.shape} but labels {truth.shape}: one x,y,w,h per frame is needed")
    boxes[:1] = truth[:1]
    usable = np.isfinite(boxes).all(axis=1) & (boxes[:, 2:] > 0).all(axis=1)
    # The latest usable row; the first stands for itself, whatever it holds.
    boxes = boxes[np.maximum.accumulate(np.where(usable, np.arange(len(boxes)), 0))]
    with np.errstate(divide="ignore", invalid="ignore"):
        valid = (truth > 0).all(axis=1) if convention == "otb" else ~np.isnan(truth).any(axis=1)
        error = centre_error(boxes, truth)
        normalized = np.linalg.norm((centre(boxes) - centre(truth)) / truth[:, 2:], axis=1)
        overlaps = overlap(boxes, truth)
    invalid = int((~valid).sum())
    if convention == "otb":
        error, normalized, overlaps = (
            np.where(valid, v, bad) for v, bad in ((error, 0), (normalized, 0), (overlaps, -1))
        )
    else:
        error, normalized, overlaps = error[valid], normalized[valid], overlaps[valid]
    if not len(error):
        raise UserError("no row has a label: nothing can be scored")
    return Scores(
        (error[:, None] <= PRECISION_THRESHOLDS).mean(axis=0),
        (normalized[:, None] <= NORMALIZED_THRESHOLDS).mean(axis=0),
        (overlaps[:, None] > OVERLAP_THRESHOLDS).mean(axis=0),
        len(error),
        invalid,
    )


def mean_scores(scores: Iterable[Scores]) -> Scores:
    """Mean over sequences, each counting the same, as all benchmarks do."""
    listed = list(scores)
    return Scores(
        np.mean([s.precision_curve for s in listed], axis=0),
        np.mean([s.normalized_curve for s in listed], axis=0),
        np.mean([s.success_curve for s in listed], axis=0),
        sum(s.frames for s in listed),
        sum(s.invalid for s in listed),
    )

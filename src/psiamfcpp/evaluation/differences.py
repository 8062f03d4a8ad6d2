"""Paired differences between trackers, with bootstrap intervals over sequences (Efron and Tibshirani 1993, ch. 13)."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import FloatArray

FEW = 10
"""with fewer sequences an interval of this kind is too narrow to be believed"""
LEVEL = 0.95
_RESAMPLES = 2000


@dataclass(frozen=True)
class Difference:
    """By how much a tracker exceeds another in one figure, on the sequences that both have."""

    mean: float
    low: float
    high: float
    """bounds of the interval of 95 percent"""
    sequences: int

    @property
    def verdict(self) -> str:
        """What may be said of it: higher, lower, not shown, or too few sequences."""
        if self.sequences < FEW:
            return "too few sequences"
        return "higher" if self.low > 0 else "lower" if self.high < 0 else "not shown"


def paired_difference(first: Mapping[str, float], second: Mapping[str, float], seed: int = 0) -> Difference:
    """Return the mean difference between two trackers, with its interval.

    Sequences are drawn with replacement; both trackers are taken on the same ones, so that what makes a sequence hard
    for both does not widen the interval. The bounds are percentiles of the means of 2,000 draws.

    Args:
        first: a figure of one tracker by sequence.
        second: the same of the other.
        seed: of the draw; equal seeds give equal intervals.

    Raises:
        UserError: they have no sequence in common.
    """
    common = [name for name in first if name in second]
    if not common:
        raise UserError("two trackers without a common sequence cannot be compared: run both on the same")
    differences = np.array([first[name] - second[name] for name in common])
    means = _shares(len(common), seed) @ differences
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Difference(float(differences.mean()), float(low), float(high), len(common))


@functools.cache
def _shares(count: int, seed: int) -> FloatArray:
    """Return the share ``(resamples, count)`` of each sequence in each draw."""
    return np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=_RESAMPLES) / count

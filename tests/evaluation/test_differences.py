"""Paired differences and their intervals."""

from __future__ import annotations

import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.differences import FEW, paired_difference


def figures(values: list[float]) -> dict[str, float]:
    return {f"s{i}": value for i, value in enumerate(values)}


def test_a_constant_difference_has_no_width() -> None:
    hard = np.random.default_rng(0).random(30)
    found = paired_difference(figures(list(hard + 0.1)), figures(list(hard)))
    assert (found.mean, found.low, found.high) == pytest.approx((0.1, 0.1, 0.1))
    assert (found.verdict, found.sequences) == ("higher", 30)


def test_the_interval_is_that_of_the_mean() -> None:
    # of normal differences the interval is close to mean +- 1.96 s / sqrt(n)
    drawn = np.random.default_rng(1).normal(0.02, 0.1, 400)
    found = paired_difference(figures(list(drawn)), figures([0.0] * 400))
    assert found.mean == pytest.approx(drawn.mean())
    half = 1.96 * drawn.std() / 20
    assert (found.low, found.high) == pytest.approx((drawn.mean() - half, drawn.mean() + half), abs=0.1 * half)


def test_exchanged_trackers_exchange_the_bounds() -> None:
    one, two = (figures(list(np.random.default_rng(seed).random(40))) for seed in (2, 3))
    first, second = paired_difference(one, two), paired_difference(two, one)
    assert (first.mean, first.low, first.high) == pytest.approx((-second.mean, -second.high, -second.low))
    assert first == paired_difference(one, two)


@pytest.mark.parametrize(
    ("count", "step", "verdict"),
    [(FEW - 1, 1.0, "too few sequences"), (FEW, 1.0, "higher"), (FEW, -1.0, "lower"), (FEW, 0.0, "not shown")],
)
def test_verdicts(count: int, step: float, verdict: str) -> None:
    assert paired_difference(figures([step] * count), figures([0.0] * count)).verdict == verdict


def test_only_common_sequences_count() -> None:
    assert paired_difference({"a": 1.0, "b": 0.5}, {"b": 0.25, "c": 1.0}).mean == 0.25
    with pytest.raises(UserError, match="without a common sequence"):
        paired_difference({"a": 1.0}, {"b": 1.0})

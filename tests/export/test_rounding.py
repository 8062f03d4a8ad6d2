"""Weights as whole numbers, whose errors cancel out."""

from __future__ import annotations

import numpy as np
import pytest

from psiamfcpp.export.rounding import LARGEST, filter_steps, rounded


@pytest.mark.parametrize("side", [1, 3, 5])
def test_errors_of_rounding_cancel_out(side: int) -> None:
    weight = (np.random.default_rng(0).standard_normal((16, 24, side, side)) * 30).clip(-126, 126).astype(np.float32)
    found = rounded(weight)
    assert np.array_equal(found, np.rint(found))
    assert np.abs((weight - found).sum(axis=(1, 2, 3))).max() <= 0.5 + 1e-3
    assert np.abs((weight - found).sum(axis=(2, 3))).max() <= 1.5
    assert np.abs((weight - np.rint(weight)).sum(axis=(1, 2, 3))).max() > 1


def test_the_largest_weight_of_a_filter_takes_all_steps_and_zeros_divide_by_no_zero() -> None:
    weight = np.array([[1.0, -4.0], [0.0, 0.0]], np.float32).reshape(2, 2, 1, 1)
    steps = filter_steps(weight)
    assert steps[0] * LARGEST == pytest.approx(4)
    assert steps[1] > 0

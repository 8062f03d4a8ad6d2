"""From peaks to probabilities, and from these to states."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiamfcpp.spec import Calibration
from psiamfcpp.trackers.siamfcpp.confidence import LOST_AFTER, StateMachine, confidence

# sigmoid(1 + 2 logit(peak) + 0.5 contrast)
FITTED = Calibration(bias=1.0, score_weight=2.0, contrast_weight=0.5)
peaks, contrasts = st.floats(0, 1), st.floats(-10, 10)


@pytest.mark.parametrize("peak", [0.02, 0.25, 0.5, 0.95])
def test_without_calibration_the_confidence_is_the_peak(peak: float) -> None:
    assert confidence(peak, 3.0, Calibration()) == pytest.approx(peak)


@pytest.mark.parametrize(
    ("peak", "contrast", "expected"),
    [
        (0.5, 0.0, 0.731059),  # 1
        (0.5, -2.0, 0.5),  # 1 - 1
        (0.8, 2.0, 0.991612),  # 1 + 2 ln 4 + 1 = 4.772589
        (0.2, 0.0, 0.145221),  # 1 - 2 ln 4 = -1.772589
    ],
)
def test_confidence_weighs_peak_and_contrast(peak: float, contrast: float, expected: float) -> None:
    assert confidence(peak, contrast, FITTED) == pytest.approx(expected, abs=1e-6)


@given(peaks, peaks, contrasts, contrasts)
def test_confidence_rises_with_peak_and_contrast(a: float, b: float, c: float, d: float) -> None:
    low, high = confidence(min(a, b), min(c, d), FITTED), confidence(max(a, b), max(c, d), FITTED)
    assert low <= high


@given(st.floats(-1, 2), st.floats(-1e6, 1e6))
def test_confidence_is_a_probability_whatever_the_network_says(peak: float, contrast: float) -> None:
    assert 0 <= confidence(peak, contrast, FITTED) <= 1


T, U, L = "tracking", "unsure", "lost"


@pytest.mark.parametrize(
    ("values", "states"),
    [
        ([0.9, 0.5, 0.51], [T, T, T]),  # the limit itself is still sure
        ([0.9, 0.49, 0.2, 0.9], [T, U, U, T]),
        ([0.1] * (LOST_AFTER - 1) + [0.9], [U] * (LOST_AFTER - 1) + [T]),
        ([0.1] * LOST_AFTER, [U] * (LOST_AFTER - 1) + [L]),
        # one frame that is not doubted, though unsure, starts the count anew
        ([0.1] * 7 + [0.2] + [0.1] * 7, [U] * 15),
        ([0.3] * 30, [U] * 30),  # for ever unsure is not lost
        ([0.1] * 8 + [0.2, 0.49, 0.5], [U] * 7 + [L, L, L, T]),  # where it is expected, more likely than not is enough
        # after that the count starts anew too
        ([0.1] * 8 + [0.8] + [0.1] * 8, [U] * 7 + [L, T] + [U] * 7 + [L]),
        ([0.1] * 40 + [0.9, 0.4, 0.9], [U] * 7 + [L] * 33 + [T, U, T]),
    ],
)
def test_states(values: list[float], states: list[str]) -> None:
    machine = StateMachine(Calibration(unsure_below=0.5, lost_below=0.2, regain_above=0.8))
    assert machine.state == "tracking"
    assert [machine.step(value) for value in values] == states
    assert machine.state == states[-1]


def test_elsewhere_a_lost_target_is_taken_up_by_no_less_than_the_limit_for_that() -> None:
    machine = StateMachine(Calibration(unsure_below=0.5, lost_below=0.2, regain_above=0.8))
    for _ in range(LOST_AFTER):
        machine.step(0.1)
    assert [machine.step(value, elsewhere=True) for value in (0.3, 0.79, 0.8)] == [L, L, T]

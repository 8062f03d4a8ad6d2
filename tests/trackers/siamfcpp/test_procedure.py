"""One step of the procedure, on score maps made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiamfcpp.spec import TrackingConstants
from psiamfcpp.trackers.siamfcpp.procedure import (
    Estimate,
    FloatMap,
    Target,
    contrast,
    cosine_window,
    estimate,
    hidden,
    smooth,
)

N = 17
K, WINDOW = 0.05, 0.25
CONSTANTS = TrackingConstants(test_lr=0.5, window_influence=WINDOW, penalty_k=K)
# The context of a square is twice its side, 127 here: the crop then has the frame's own scale.
AT_SCALE_1 = Target(100, 80, 63.5, 63.5)


def box(cx: float, cy: float, w: float, h: float) -> tuple[float, float, float, float]:
    """Corners in the crop, the width counting pixels."""
    return (cx - (w - 1) / 2, cy - (h - 1) / 2, cx + (w - 1) / 2, cy + (h - 1) / 2)


def maps(
    peaks: dict[tuple[int, int], float], w: float = 63.5, h: float = 63.5, rest: float = 0.0
) -> tuple[FloatMap, FloatMap]:
    """Scores at the given cells, and at every cell a box of one size about it."""
    scores = np.full((N, N), rest)
    for cell, value in peaks.items():
        scores[cell] = value
    boxes = np.array([[box(87 + 8 * j, 87 + 8 * i, w, h) for j in range(N)] for i in range(N)])
    return scores, boxes


def step(
    scores: FloatMap, boxes: FloatMap, previous: Target = AT_SCALE_1, constants: TrackingConstants = CONSTANTS
) -> Estimate:
    return estimate(scores, boxes, previous, 303, 127, constants, cosine_window(N))


def test_the_window_is_1_at_the_centre_and_0_at_the_rim() -> None:
    window = cosine_window(N)
    assert window.shape == (N, N)
    assert window[8, 8] == 1
    assert window[0, :].max() == window[:, -1].max() == pytest.approx(0)
    # half-way to the rim the cosine is at its half, and both axes multiply
    assert window[8, 4] == pytest.approx(0.5)
    assert window[4, 4] == pytest.approx(0.25)


def test_without_a_window_the_best_cell_is_chosen_wherever_it_is() -> None:
    plain = TrackingConstants(window_influence=0, penalty_k=K)
    found = step(*maps({(8, 8): 0.59, (0, 16): 0.6}), constants=plain)
    assert (found.cell, found.score) == ((0, 16), 0.6)


@pytest.mark.parametrize(
    ("peaks", "chosen"),
    [
        ({(8, 10): 0.9, (8, 16): 0.9}, (8, 10)),  # a tie goes to the nearer
        ({(8, 8): 0.6, (0, 0): 0.9}, (8, 8)),  # 0.6 * 0.75 + 0.25 = 0.700 against 0.9 * 0.75 = 0.675
        ({(8, 8): 0.5, (0, 0): 0.9}, (0, 0)),  # 0.625 against 0.675
        ({}, (8, 8)),
    ],
)
def test_the_window_weighs_against_motion(peaks: dict[tuple[int, int], float], chosen: tuple[int, int]) -> None:
    assert step(*maps(peaks)).cell == chosen


@pytest.mark.parametrize(
    ("w", "h", "expected"),
    [
        (63.5, 63.5, 1.0),
        (127.0, 127.0, math.exp(-K)),  # twice the size: 2 * 1 - 1
        (31.75, 31.75, math.exp(-K)),  # half the size costs as much
        # Twice as wide and half as high: the shape changed by 4; the context is
        # sqrt((127 + 79.375)(31.75 + 79.375)) = 151.437, so the size by 151.437 / 127 = 1.19242.
        (127.0, 31.75, math.exp(-(4 * 1.19242 - 1) * K)),
        (31.75, 127.0, math.exp(-(4 * 1.19242 - 1) * K)),
    ],
)
def test_penalty(w: float, h: float, expected: float) -> None:
    assert step(*maps({(8, 8): 0.9}, w, h)).penalty == pytest.approx(expected, rel=1e-5)


def test_the_penalty_decides_between_equal_scores() -> None:
    scores, boxes = maps({(8, 6): 0.9, (8, 10): 0.9})
    boxes[8, 6] = box(87 + 48, 151, 130, 130)
    assert step(scores, boxes).cell == (8, 10)


def test_a_box_in_the_crop_becomes_a_place_in_the_frame() -> None:
    scores, boxes = maps({(7, 10): 0.9})
    # 16 right of and 8 above the crop's centre, which is 303 // 2 = 151
    boxes[7, 10] = box(167, 143, 70, 50)
    assert step(scores, boxes).target == Target(116, 72, 70, 50)
    # a target half as large is enlarged twice, so all that is read in the crop counts half
    small = Target(100, 80, 31.75, 31.75)
    assert step(scores, boxes, small).target == Target(108, 76, 35, 25)


def test_an_inverted_box_does_no_harm() -> None:
    scores, boxes = maps({(8, 8): 0.9})
    boxes[:, :, 2:] = boxes[:, :, :2] - 50
    found = step(scores, boxes)
    assert found.target.w > 0
    assert found.target.h > 0
    assert 0 <= found.penalty <= 1


@given(st.floats(0, 1), st.integers(0, N - 1), st.integers(0, N - 1), st.floats(4, 250), st.floats(4, 250))
def test_an_estimate_is_always_the_box_of_its_cell(peak: float, i: int, j: int, w: float, h: float) -> None:
    scores, boxes = maps({(i, j): peak}, w, h)
    found = step(scores, boxes)
    row, column = found.cell
    assert found.score == scores[row, column]
    assert 0 < found.penalty <= 1
    assert (found.target.cx, found.target.cy) == pytest.approx((100 + 8 * (column - 8), 80 + 8 * (row - 8)))
    assert (found.target.w, found.target.h) == pytest.approx((w, h))


def smoothed(found: Target, rate: float, previous: Target = AT_SCALE_1) -> Target:
    return smooth(previous, Estimate(found, 0.9, 1.0, (8, 8)), rate, (480, 640, 3), smallest=10)


@pytest.mark.parametrize(("rate", "w", "h"), [(0.0, 40, 20), (0.25, 45, 25), (1.0, 60, 40)])
def test_the_size_follows_at_its_rate_and_the_centre_at_once(rate: float, w: float, h: float) -> None:
    previous = Target(100, 80, 40, 20)
    assert smoothed(Target(110, 75, 60, 40), rate, previous) == Target(110, 75, w, h)


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (Target(-5, -0.5, 50, 50), Target(0, 0, 50, 50)),
        (Target(700, 500, 50, 50), Target(640, 480, 50, 50)),
        (Target(100, 80, 5000, 5000), Target(100, 80, 640, 480)),
        (Target(100, 80, 3, 50), Target(100, 80, 10, 50)),
        (Target(100, 80, 50, 9.9), Target(100, 80, 50, 10)),
    ],
)
def test_the_target_stays_in_the_frame_and_is_not_followed_into_nothing(found: Target, expected: Target) -> None:
    assert smoothed(found, 1.0) == expected


# contrast


def test_a_lone_peak_stands_out() -> None:
    scores, boxes = maps({(8, 8): 0.9}, rest=0.009)
    # (0.9 + 0.001) / (0.009 + 0.001)
    assert contrast(scores, boxes, (8, 8)) == pytest.approx(math.log(90.1))


def test_an_equal_peak_elsewhere_takes_all_contrast() -> None:
    assert contrast(*maps({(8, 2): 0.9, (8, 14): 0.9}), (8, 2)) == pytest.approx(0)


def test_cells_of_the_same_target_do_not_compete() -> None:
    # 16 pixels from the peak lies within its box, 31.25 to each side; 32 does not
    assert contrast(*maps({(8, 8): 0.9, (8, 10): 0.8}), (8, 8)) == pytest.approx(math.log(901))
    assert contrast(*maps({(8, 8): 0.9, (8, 12): 0.8}), (8, 8)) == pytest.approx(math.log(0.901 / 0.801))
    # nor do far cells whose boxes lie on the target: they have seen it too
    scores, boxes = maps({(8, 8): 0.9, (8, 14): 0.8})
    boxes[8, 14] = box(155, 151, 60, 60)
    assert contrast(scores, boxes, (8, 8)) == pytest.approx(math.log(901))


def test_a_cell_that_is_not_the_best_has_negative_contrast() -> None:
    assert contrast(*maps({(8, 2): 0.4, (8, 14): 0.9}), (8, 2)) == pytest.approx(math.log(0.401 / 0.901))


def test_a_box_over_the_whole_crop_has_nothing_to_compete_with() -> None:
    assert contrast(*maps({(8, 8): 0.9}, w=303, h=303, rest=0.5), (8, 8)) == pytest.approx(math.log(901))


# hidden


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_only_cells_whose_boxes_lie_in_the_seen_target_are_hidden(scale: float) -> None:
    scores, boxes = maps({(8, 8): 0.9, (8, 14): 0.8, (2, 8): 0.7}, rest=0.1)
    before = scores.copy()
    around = Target(100, 80, 63.5 / scale, 63.5 / scale)
    # 48 pixels right of the crop's centre lies cell (8, 14); the box reaches 20 pixels of the crop to each side
    rest = hidden(scores, boxes, around, Target(100 + 48 / scale, 80, 40 / scale, 40 / scale), scale, 151)
    rows, columns = np.nonzero(rest == 0)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (6, 10, 12, 16)
    assert len(rows) == 25
    assert rest[8, 8] == 0.9
    np.testing.assert_array_equal(scores, before)

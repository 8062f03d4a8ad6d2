"""Metrics, on sequences whose figures were worked out by hand."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from psiamfcpp import UserError
from psiamfcpp.evaluation.metrics import Convention, Scores, mean_scores, score_sequence

NAN = math.nan
BOX = (10, 10, 20, 20)


@pytest.fixture(autouse=True)
def no_warning() -> Iterator[None]:
    """Labels without area are no reason to warn on a user's terminal."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.mark.parametrize("convention", ["otb", "got10k"])
def test_a_perfect_result(convention: Convention) -> None:
    boxes = [BOX, (12, 9, 22, 18), (300.5, 100.25, 7, 5)]
    figures = score_sequence(boxes, boxes, convention).figures
    # an overlap of 1 lies above the thresholds 0, 0.05, ... 0.95, but not above 1: 20 of 21
    assert figures == {"precision": 1, "normalized_precision": 1, "auc": pytest.approx(20 / 21), "success50": 1}


@pytest.mark.parametrize("convention", ["otb", "got10k"])
def test_a_sequence_by_hand(convention: Convention) -> None:
    result = [
        (500, 500, 3, 3),  # the first is replaced by the label: error 0, overlap 1
        (30, 10, 20, 20),  # 20 px, exactly the threshold: a hit; the boxes touch: overlap 0
        (10, 31, 20, 20),  # 21 px: a miss
        (20, 10, 20, 20),  # 10 px; 10 * 20 of 800 - 200: overlap 1/3
    ]
    scores = score_sequence([BOX] * 4, result, convention)
    assert (scores.frames, scores.invalid) == (4, 0)
    assert_allclose(scores.precision_curve[[0, 9, 10, 19, 20, 21, 50]], [1 / 4, 1 / 4, 2 / 4, 2 / 4, 3 / 4, 1, 1])
    # divided by the sides: 0, 1, 1.05 and 0.5
    assert_allclose(scores.normalized_curve[[0, 20, 49, 50]], [1 / 4, 1 / 4, 1 / 4, 2 / 4])
    # 1 lies above 20 of the thresholds, 1/3 above the 7 up to 0.30, 0 above none
    assert_allclose(scores.success_curve[[0, 6, 7, 19, 20]], [2 / 4, 2 / 4, 1 / 4, 1 / 4, 0])
    assert scores.figures == {
        "precision": 3 / 4,
        "normalized_precision": 1 / 4,
        "auc": pytest.approx((20 + 7) / (21 * 4)),
        "success50": 1 / 4,
    }


def test_an_overlap_at_a_threshold_is_not_above_it() -> None:
    # half of the box: overlap 200 / 400, exactly 0.5
    scores = score_sequence([BOX] * 2, [BOX, (10, 10, 20, 10)])
    assert scores.figures["success50"] == 1 / 2  # the first frame alone
    assert scores.success_curve[9] == 1


def test_the_width_and_the_height_normalize_each_their_axis() -> None:
    # 8 px along a side of 80, 1 px along a side of 10: 0.1 each, so sqrt(0.02) = 0.1414
    scores = score_sequence([(5, 5, 80, 10)] * 2, [(5, 5, 80, 10), (13, 6, 80, 10)])
    assert_allclose(scores.normalized_curve[[14, 15]], [1 / 2, 1])


TRUTH = [BOX, (NAN,) * 4, (0, 0, 0, 0), (10, 0, 20, 20), (10, 10, 20, 20)]
RESULT = [BOX, BOX, BOX, (10, 0, 20, 20), (31, 10, 20, 20)]


def test_otb_counts_unlabelled_rows_as_hit_and_miss() -> None:
    scores = score_sequence(TRUTH, RESULT, "otb")
    # NaN, zero and y = 0 are invalid; the last row is labelled, and missed by 21 px
    assert (scores.frames, scores.invalid) == (5, 3)
    assert scores.figures == {
        "precision": 4 / 5,
        "normalized_precision": 4 / 5,
        "auc": pytest.approx(20 / (21 * 5)),  # the first frame alone
        "success50": 1 / 5,
    }
    assert scores.precision_curve[0] == 4 / 5
    assert scores.success_curve[0] == 1 / 5


def test_got10k_drops_rows_with_nan_alone() -> None:
    scores = score_sequence(TRUTH, RESULT, "got10k")
    # The label without area has its centre at -0.5, -0.5, which is 28 px off. y = 0 is a row as any other.
    assert (scores.frames, scores.invalid) == (4, 1)
    half = dict.fromkeys(("precision", "normalized_precision", "success50"), 2 / 4)
    assert scores.figures == {**half, "auc": pytest.approx(40 / (21 * 4))}


def test_one_nan_in_a_row_is_enough() -> None:
    truth = [BOX, (10, NAN, 20, 20)]
    assert score_sequence(truth, [BOX, BOX], "got10k").frames == 1
    assert score_sequence(truth, [BOX, BOX], "otb").figures["success50"] == 1 / 2


@pytest.mark.parametrize("bad", [(NAN, 10, 20, 20), (10, 10, math.inf, 20), (90, 90, 0, 20), (90, 90, 20, -1)])
def test_a_result_without_a_box_repeats_the_one_before(bad: tuple[float, ...]) -> None:
    moved = (20, 10, 20, 20)
    given_up = score_sequence([BOX] * 4, [BOX, moved, bad, bad])
    repeated = score_sequence([BOX] * 4, [BOX, moved, moved, moved])
    assert given_up.figures == repeated.figures
    # even the very first label can be what is repeated
    assert score_sequence([BOX] * 2, [bad, bad]).figures["success50"] == 1


def test_neither_labels_nor_results_are_changed() -> None:
    truth, result = np.array([BOX] * 2, float), np.full((2, 4), NAN)
    score_sequence(truth, result)
    assert np.isnan(result).all()
    assert (truth == BOX).all()


@pytest.mark.parametrize(
    ("truth", "result", "convention", "message"),
    [
        ([BOX] * 3, [BOX] * 2, "otb", r"results have shape \(2, 4\) but labels \(3, 4\)"),
        (BOX, BOX, "otb", "one x,y,w,h per frame is needed"),
        ([BOX[:3]], [BOX[:3]], "otb", "one x,y,w,h per frame is needed"),
        ([(NAN,) * 4] * 2, [BOX] * 2, "got10k", "no row has a label"),
    ],
)
def test_what_cannot_be_scored_is_refused(truth: object, result: object, convention: Convention, message: str) -> None:
    with pytest.raises(UserError, match=message):
        score_sequence(truth, result, convention)  # type: ignore[arg-type]


whole = st.integers(-50, 50)
places = st.lists(st.tuples(whole, whole, st.integers(1, 60), st.integers(1, 60)), min_size=2, max_size=8)


@given(places, whole, whole, st.integers(0, 5), st.integers(0, 5), st.sampled_from(["otb", "got10k"]))
def test_a_longer_shift_never_raises_a_curve(
    truth: list[tuple[int, ...]], dx: int, dy: int, near: int, more: int, convention: Convention
) -> None:
    labels, direction = np.array(truth, float), np.array([dx, dy, 0, 0])
    a, b = (score_sequence(labels, labels + k * direction, convention) for k in (near, near + more))
    assert (b.precision_curve <= a.precision_curve).all()
    assert (b.normalized_curve <= a.normalized_curve + 1e-12).all()
    assert (b.success_curve <= a.success_curve).all()


@given(places, st.integers(0, 10**6), st.sampled_from(["otb", "got10k"]))
def test_curves_are_shares_and_monotone(truth: list[tuple[int, ...]], seed: int, convention: Convention) -> None:
    labels = np.array(truth, float)
    scores = score_sequence(labels, labels + np.random.default_rng(seed).normal(0, 20, labels.shape), convention)
    for curve, sign in ((scores.precision_curve, 1), (scores.normalized_curve, 1), (scores.success_curve, -1)):
        assert (np.diff(curve) * sign >= 0).all()
        assert ((curve >= 0) & (curve <= 1)).all()


def three() -> list[Scores]:
    rng = np.random.default_rng(0)
    truth = rng.uniform(20, 60, (9, 4))
    return [score_sequence(truth[:n], truth[:n] + rng.normal(0, 9, (n, 4))) for n in (3, 5, 9)]


def test_sequences_count_the_same_whatever_their_length_and_order() -> None:
    a, b, c = three()
    mean = mean_scores([a, b, c])
    assert mean.frames == 17
    for name, value in mean.figures.items():
        assert value == pytest.approx(np.mean([s.figures[name] for s in (a, b, c)]))
        assert mean_scores(iter([c, a, b])).figures[name] == pytest.approx(value)
    assert mean_scores([a]).figures == pytest.approx(a.figures)

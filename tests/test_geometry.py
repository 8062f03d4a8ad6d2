"""Boxes: the two conventions of centre and corner, overlap, and which boxes can be tracked."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from psiamfcpp import UserError
from psiamfcpp.geometry import (
    Box,
    centre,
    centre_error,
    check_box,
    context_side,
    from_centre,
    from_corners,
    overlap,
    to_centre,
)

places = st.floats(-1e4, 1e4)
sides = st.floats(0.1, 1e4)
boxes = st.tuples(places, places, sides, sides)


def test_width_counts_pixels() -> None:
    # columns 10..13 and rows 20..24: the middle column is 11.5, the middle row 22
    assert_allclose(centre((10, 20, 4, 5)), (11.5, 22))
    assert_allclose(from_corners((10, 20, 13, 24)), (10, 20, 4, 5))


@given(boxes)
def test_a_centre_can_be_undone(box: Box) -> None:
    cx, cy = centre(box)
    assert_allclose(from_centre(cx, cy, *box[2:]), box, rtol=1e-9, atol=1e-7)


def test_arrays_of_any_shape_go_through() -> None:
    many = np.arange(24.0).reshape(2, 3, 4) + 1
    assert centre(many).shape == (2, 3, 2)
    assert from_corners(many).shape == many.shape
    assert overlap(many, many[:, :1]).shape == centre_error(many[0, 0], many).shape == (2, 3)


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ((0, 0, 10, 10), (0, 0, 10, 10), 1),
        ((0, 0, 10, 10), (5, 5, 10, 10), 25 / 175),
        ((0, 0, 10, 10), (2, 3, 5, 4), 20 / 100),  # contained
        ((0, 0, 10, 10), (10, 0, 10, 10), 0),  # touching
        ((0, 0, 10, 10), (9, 9, 10, 10), 1 / 199),  # one pixel in common
        ((0, 0, 10, 10), (50, 50, 10, 10), 0),
        ((0, 0, 10, 10), (2, 2, 0, 5), 0),  # empty
        ((5, 5, 0, 0), (5, 5, 0, 0), 0),  # both empty
        ((0, 0, 10, 10), (5, 5, -3, -3), 0),
        ((0, 0, 10, 10), (math.nan, 0, 10, 10), 0),
    ],
)
def test_overlap(a: Box, b: Box, expected: float) -> None:
    assert overlap(a, b) == pytest.approx(expected)
    assert overlap(b, a) == pytest.approx(expected)


@given(boxes, boxes)
def test_overlap_is_symmetric_and_within_bounds(a: Box, b: Box) -> None:
    value = overlap(a, b)
    assert 0 <= value <= 1 + 1e-9
    assert value == pytest.approx(float(overlap(b, a)))
    assert overlap(a, a) == pytest.approx(1, rel=1e-6)


def test_centre_error() -> None:
    # centres 4.5, 4.5 and 7.5, 8.5: 3 and 4 pixels apart
    assert centre_error((0, 0, 10, 10), (3, 4, 10, 10)) == pytest.approx(5)
    # a box that grows about its corner moves its centre by half of that
    assert centre_error((0, 0, 10, 10), (0, 0, 20, 10)) == pytest.approx(5)


@pytest.mark.parametrize(
    "box",
    [
        (10, 10, 20, 20),
        (0, 0, 100, 80),  # the whole frame
        (-9, -9, 20, 20),  # partly outside, its centre 0.5, 0.5 inside
        (99, 79, 1, 1),  # the last pixel
        (0.25, 0.5, 2.5, 1.75),
    ],
)
def test_boxes_that_can_be_tracked_come_back_as_they_are(box: Box) -> None:
    assert check_box(box, (80, 100, 3)) == box
    assert check_box(np.array(box), (80, 100)) == box
    assert check_box([list(box)], (80, 100)) == box


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ((math.nan, 10, 20, 20), "box nan,10,20,20 is not four finite numbers"),
        ((10, 10, math.inf, 20), "is not four finite numbers"),
        ((10, 10, 20), "box 10,10,20 is not four finite numbers"),
        ((10, 10, 20, 20, 1), "is not four finite numbers"),
        ((), "is not four finite numbers"),
        ((10, 10, 0, 20), "box 10,10,0,20 holds no pixel"),
        ((10, 10, 20, -1), "holds no pixel"),
        ((10, 10, 20, 0.75), "holds no pixel"),
        ((100, 10, 20, 20), r"lies outside the frame \(100x80\)"),  # centre 109.5
        ((10, 79, 2, 2), "lies outside the frame"),  # centre 79.5, the last row is 79
        ((99, 10, 2, 2), "lies outside the frame"),  # centre 99.5, the last column is 99
        ((-20, 10, 20, 20), "lies outside the frame"),  # centre -10.5
    ],
)
def test_boxes_that_cannot_be_tracked_are_named(box: Box, message: str) -> None:
    with pytest.raises(UserError, match=message):
        check_box(box, (80, 100, 3))


def test_context_side() -> None:
    assert context_side(50, 50) == pytest.approx(100)  # of a square: twice its side
    assert context_side(3, 23) == pytest.approx(24)  # p = 13: sqrt(16 * 36)


@given(sides, sides)
def test_context_holds_the_target_and_has_no_preferred_axis(w: float, h: float) -> None:
    assert context_side(w, h) == pytest.approx(context_side(h, w))
    assert context_side(w, h) >= (w + h) * 0.86  # sqrt(3) / 2 for a line, 1 for a square


def test_centre_and_size_are_the_inverse_of_from_centre() -> None:
    # 40 columns from 10 on: 10 to 49, so that the centre lies between 29 and 30
    assert to_centre((10, 20, 40, 31)) == (29.5, 35.0, 40.0, 31.0)
    assert from_centre(*to_centre((10, 20, 40, 31))) == (10, 20, 40, 31)

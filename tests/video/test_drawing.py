"""Drawing: what is drawn shows, stays inside the frame and leaves the frame itself alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from psiamfcpp.geometry import Box
from psiamfcpp.trackers import Track
from psiamfcpp.video.drawing import STATE_COLOURS, Colour, Overlay, draw, draw_status, draw_targets

COLOUR = STATE_COLOURS["tracking"]


def black(width: int = 640, height: int = 360) -> np.ndarray:
    return np.zeros((height, width, 3), np.uint8)


def strip(image: np.ndarray, plain: np.ndarray) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of where two drawings differ."""
    rows, columns = np.nonzero((image != plain).any(axis=2))
    return columns.min(), rows.min(), columns.max(), rows.max()


def test_the_outline_lies_on_the_edge_of_the_box() -> None:
    image = draw(black(), (100, 80, 41, 31), "")
    for x, y in ((100, 90), (140, 90), (120, 80), (120, 110)):
        assert tuple(image[y, x]) == COLOUR
    assert not image[85:105, 105:135].any()
    assert not image[:78].any()


def test_the_frame_is_left_alone() -> None:
    frame = black()
    draw(frame, (10, 10, 50, 50), "car")
    draw_status(frame, ["a"])
    assert not frame.any()


@pytest.mark.parametrize(
    "box", [(0, 0, 40, 30), (600, 0, 40, 30), (0, 330, 40, 30), (600, 330, 40, 30), (0, 0, 640, 360)]
)
def test_a_label_is_whole_wherever_the_box_is(box: Box) -> None:
    frame = black()
    middle = draw(frame, (300, 200, 40, 30), "tracking 0.97")
    inside = strip(middle, draw(frame, (300, 200, 40, 30), ""))
    image = draw(frame, box, "tracking 0.97")
    # the strip hides some of its own outline's colour, so count the label's ink and not its extent
    ink = [((i > 0).any(axis=2) & (i != COLOUR).any(axis=2)).sum() for i in (middle, image)]
    assert inside[2] > inside[0]
    assert ink[0] == ink[1] > 0


@pytest.mark.parametrize(
    "box",
    [
        (-1e9, -1e9, 2e9, 2e9),
        (1e12, 5, 10, 10),
        (-500, -500, 10, 10),
        (float("nan"), 0, 1, 1),
        (0, 0, float("inf"), 1),
    ],
)
def test_a_box_far_off_does_no_harm(box: Box) -> None:
    assert draw(black(), box, "lost").shape == (360, 640, 3)


@settings(max_examples=15)
@given(st.integers(1, 300), st.integers(1, 300), st.text(max_size=30), st.tuples(*[st.floats(-400, 400)] * 4))
def test_any_frame_and_label_can_be_drawn(width: int, height: int, label: str, box: Box) -> None:
    frame = black(width, height)
    assert draw(frame, box, label).shape == frame.shape
    assert draw_status(frame, [label, label]).shape == frame.shape


def test_the_label_grows_with_the_frame() -> None:
    heights = []
    for scale in (1, 3):
        frame, box = black(640 * scale, 360 * scale), (200.0, 200.0, 90.0, 90.0)
        _, top, _, bottom = strip(draw(frame, box, "tracking"), draw(frame, box, ""))
        heights.append(bottom - top)
    assert heights[1] > 1.8 * heights[0]


@pytest.mark.parametrize("colour", STATE_COLOURS.values())
def test_the_label_stands_out_from_its_strip(colour: Colour) -> None:
    image = draw(black(), (200, 200, 90, 90), "MMMM", colour)
    light = image @ np.array([0.114, 0.587, 0.299])
    ground = float(np.array(colour) @ np.array([0.114, 0.587, 0.299]))
    strip_rows = light[185:198, 204:230]
    assert np.abs(strip_rows - ground).max() > 80


def test_status_lines_show_at_the_top_left() -> None:
    frame = np.full((360, 640, 3), 200, np.uint8)
    one, two = draw_status(frame, ["fps 30"]), draw_status(frame, ["fps 30", "a longer line"])
    assert (one[:3, :30] < 100).all()
    assert one.max() > 200
    assert (two != frame).sum() > 2 * (one != frame).sum()
    assert (two[200:] == 200).all() and (two[:, 500:] == 200).all()
    assert (draw_status(frame, []) == frame).all()


def test_a_lost_target_is_dashed_and_keeps_its_corners() -> None:
    frame = np.zeros((240, 320, 3), np.uint8)
    solid, dashed = (
        draw_targets(frame, {1: Track((50, 60, 100, 80), 0.5, state)}, Overlay(no_label=True)).any(axis=-1)
        for state in ("tracking", "lost")
    )
    edge = (60, slice(50, 150))
    assert solid[edge].all()
    assert 0.3 < dashed[edge].mean() < 0.8
    assert dashed[60, 50]
    assert dashed[60, 149] or dashed[139, 149]


def test_a_trail_joins_the_centres_of_the_boxes_before() -> None:
    frame = np.zeros((240, 320, 3), np.uint8)
    way = [(20.0, 20.0, 10.0, 10.0), (float("nan"), 0.0, 1.0, 1.0), (1e9, 20.0, 10.0, 10.0), (120.0, 20.0, 10.0, 10.0)]
    track = Track((220, 20, 10, 10), 1.0, "tracking")
    bare = draw_targets(frame, {1: track}, Overlay(no_label=True))
    trailed = draw_targets(frame, {1: track}, Overlay(no_label=True), {1: way})
    assert not bare[24, 30:200].any()
    assert trailed[23:27, 30:200].any(axis=(0, 2)).all()

"""Which frames of a source are followed."""

from __future__ import annotations

import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.video.span import Span, frame_number, shots

FRAMES = [np.full((2, 2, 3), value, np.uint8) for value in range(20)]


@pytest.mark.parametrize(
    ("moment", "number"),
    [("0", 0), ("2", 20), ("2.5", 25), ("#7", 7), ("1:30", 900), ("1:00:00", 36000), ("0:01.25", 12), ("3.", 30)],
)
def test_moments_are_seconds_or_frame_numbers(moment: str, number: int) -> None:
    assert frame_number(moment, 10.0) == number


@pytest.mark.parametrize("moment", ["", "-1", "#", "#-2", "#1.5", "1:2:3:4", "5s", "nan", "1e3", "٣"])
def test_anything_else_is_refused(moment: str) -> None:
    with pytest.raises(UserError, match="is no moment"):
        frame_number(moment, 10.0)


@pytest.mark.parametrize(
    ("span", "numbers"),
    [
        (Span(), list(range(20))),
        (Span("#3", "#6"), [3, 4, 5]),
        (Span("1"), list(range(10, 20))),
        (Span("#3", "#12", 4), [3, 7, 11]),
        (Span(stop="99", every=19), [0, 19]),
        (Span("#19"), [19]),
    ],
)
def test_frames_keep_their_numbers(span: Span, numbers: list[int]) -> None:
    found = list(shots(FRAMES, 10.0, span))
    assert [shot.number for shot in found] == numbers
    assert [shot.image[0, 0, 0] for shot in found] == numbers


def test_no_frame_behind_the_stop_is_kept_from_a_source() -> None:
    source = iter(FRAMES)
    list(shots(source, 10.0, Span(stop="#3")))
    # the one that ends it was read, and no other
    assert next(source)[0, 0, 0] == 4


@pytest.mark.parametrize(
    ("span", "message"),
    [
        (Span("#5", "#5"), "stop #5 is not after start #5"),
        (Span("2", "1"), "stop 1 is not after start 2"),
        (Span(every=0), "every is 0"),
        (Span("soon"), "'soon' is no moment"),
    ],
)
def test_a_span_that_holds_nothing_is_refused_before_reading(span: Span, message: str) -> None:
    with pytest.raises(UserError, match=message):
        shots(iter(()), 10.0, span)


def test_a_start_after_the_end_says_how_long_the_source_is() -> None:
    with pytest.raises(UserError, match="start #20 is after the last frame: the source has 20 frames"):
        list(shots(FRAMES, 10.0, Span("#20")))

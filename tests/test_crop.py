"""Crops: which frame pixel each output pixel shows."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from psiamfcpp.crop import crop, mean_colour, warp
from psiamfcpp.geometry import Image

FILL = (10.0, 20.0, 30.0)


def noise(height: int = 60, width: int = 80) -> Image:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def ramp(slope: int, height: int = 41, width: int = 41) -> Image:
    """Each pixel's value is ``slope`` times its column."""
    return np.repeat(np.tile(slope * np.arange(width), (height, 1))[..., None], 3, axis=2).astype(np.uint8)


def test_a_crop_of_the_whole_frame_at_its_own_size_is_the_frame() -> None:
    frame = noise(63, 63)
    assert_array_equal(crop(frame, 31, 31, 63, 63, FILL), frame)


def test_a_crop_at_full_scale_is_a_cut_out() -> None:
    frame = noise()
    # 21 columns about column 40 are 30..50, 21 rows about row 25 are 15..35
    assert_array_equal(crop(frame, 40, 25, 21, 21, FILL), frame[15:36, 30:51])


@pytest.mark.parametrize(("shift", "grey"), [(0.0, 0), (0.25, 1), (0.5, 2), (-0.5, -2), (0.75, 3)])
def test_the_centre_may_lie_between_pixels(shift: float, grey: int) -> None:
    frame = ramp(4)
    at_rest, moved = (crop(frame, 20 + s, 20, 11, 11, FILL).astype(int) for s in (0, shift))
    assert_array_equal(moved - at_rest, grey)
    # the other axis is level, so nothing changes along it
    assert_array_equal(crop(frame, 20, 20 + shift, 11, 11, FILL), at_rest)


def test_the_centres_of_corner_pixels_meet() -> None:
    # 101 columns become 51: by the corner pixels' centres, output column j shows frame column 2 j exactly
    # (by their edges it would show 1.98 j + 0.49)
    out = crop(ramp(2, 101, 101), 50, 50, 101, 51, FILL)
    assert_array_equal(out[25, :, 0], 4 * np.arange(51))


def test_an_even_side_lies_about_its_centre() -> None:
    # 4 columns about column 10 begin at 10 - 1.5
    assert_array_equal(crop(ramp(6), 10, 20, 4, 4, FILL)[0, :, 0], [51, 57, 63, 69])


def test_enlarging_interpolates() -> None:
    # 3 columns about 10 become 5: columns 9, 9.5, 10, 10.5, 11
    assert_array_equal(crop(ramp(6), 10, 20, 3, 5, FILL)[0, :, 0], [54, 57, 60, 63, 66])


def test_what_lies_outside_the_frame_is_filled() -> None:
    frame = noise()
    out = crop(frame, 0, 0, 21, 21, FILL)
    assert_array_equal(out[10:, 10:], frame[:11, :11])
    assert (out[:10] == FILL).all()
    assert (out[:, :10] == FILL).all()
    assert (crop(frame, 500, -300, 21, 9, FILL) == FILL).all()


def test_a_buffer_is_written_to_and_returned() -> None:
    frame, buffer = noise(), np.full((21, 21, 3), 7, np.uint8)
    # partly outside, so that every pixel of the buffer must be written, not only those inside the frame
    expected = crop(frame, 0, 25, 21, 21, FILL)
    assert crop(frame, 0, 25, 21, 21, FILL, buffer) is buffer
    assert_array_equal(buffer, expected)


def test_the_frame_may_be_a_view_or_read_only_and_is_left_alone() -> None:
    frame = noise()
    frame.flags.writeable = False
    before = frame.copy()
    mirrored = frame[:, ::-1]
    assert_array_equal(crop(mirrored, 30, 25, 21, 13, FILL), crop(mirrored.copy(), 30, 25, 21, 13, FILL))
    assert_array_equal(frame, before)


def test_warp_takes_output_pixels_to_frame_pixels() -> None:
    frame = noise()
    # output (x, y) shows frame (y + 5, x + 2): turned over, not merely moved
    out = warp(frame, np.array([[0.0, 1, 5], [1, 0, 2]]), 9, FILL)
    assert_array_equal(out, frame[2:11, 5:14].transpose(1, 0, 2))


def test_mean_colour_keeps_the_order_of_channels() -> None:
    frame = np.zeros((2, 2, 3), np.uint8)
    frame[..., 1], frame[0, 0] = 8, (4, 20, 100)
    assert mean_colour(frame) == (1, 11, 25)

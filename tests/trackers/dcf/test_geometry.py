"""Rounding, crops, resizing and the limits of scale, which decide whether boxes equal the authors'."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("scipy")
pytest.importorskip("numba")

from psiamfcpp.trackers.dcf import geometry, staple
from psiamfcpp.trackers.dcf.fdsst import Fdsst, FdsstConstants
from psiamfcpp.trackers.dcf.kcf import Kcf, KcfConstants
from psiamfcpp.trackers.dcf.mcct_h import McctH, McctHConstants
from psiamfcpp.trackers.dcf.staple_ca import StapleCa, StapleCaConstants

FRAME = np.random.default_rng(1).integers(0, 256, (30, 41, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("value", "rounded"), [(0.5, 1), (1.5, 2), (2.5, 3), (-0.5, -1), (-2.5, -3), (2.49, 2), (-2.4, -2), (0.0, 0)]
)
def test_halves_are_rounded_away_from_zero(value, rounded):
    assert geometry.round_half_away(value) == rounded


@given(
    centre=st.tuples(st.floats(-60, 90), st.floats(-60, 90)),
    size=st.tuples(st.floats(0, 50), st.floats(0, 50)),
    shift=st.sampled_from([0, 1]),
)
def test_crops_take_clamped_indices_about_the_floored_centre(centre, size, shift):
    n = [int(s) if s >= 1 else 2 for s in size]
    index = [
        np.clip(np.floor(c) + np.arange(1, k + 1) - np.floor((k + shift) / 2), 1, side).astype(int) - 1
        for c, k, side in zip(centre, n, FRAME.shape, strict=False)
    ]
    assert np.array_equal(geometry.crop(FRAME, centre, size, shift), FRAME[np.ix_(*index)])


def test_crops_far_outside_hold_the_nearest_corner():
    assert (geometry.crop(FRAME, (1e12, -1e12), (5, 7)) == FRAME[-1, 0]).all()


def _mean_over_areas(image, rows, columns):
    def shares(old, new):
        edges = np.arange(new + 1) * old / new
        inside = np.minimum(edges[1:, None], np.arange(old) + 1) - np.maximum(edges[:-1, None], np.arange(old))
        return np.clip(inside, 0, None) * new / old

    return np.einsum(
        "ij,jkc,lk->ilc", shares(image.shape[0], rows), image.astype(float), shares(image.shape[1], columns)
    )


@pytest.mark.parametrize("size", [(30, 20), (15, 13), (10, 30), (7, 11), (29, 30)])
def test_shrinking_by_the_area_rule_is_the_mean_over_each_pixels_area(size):
    got = geometry.resize_auto(FRAME, size).astype(float)
    assert np.abs(got - _mean_over_areas(FRAME, *size)).max() < 0.5 + 1e-3  # halves may fall either way


def test_a_half_in_an_area_falls_as_in_the_authors_version_of_opencv():
    # (5 a + b) / 6 is 0.5; in single precision, by columns first, just above. OpenCV 5 gives 0.
    image = np.zeros((6, 1, 1), np.uint8)
    image[1] = 3
    assert geometry.resize_auto(image, (5, 1))[0, 0, 0] == 1


@given(st.tuples(*[st.integers(3, 60)] * 4))
def test_the_bilinear_rule_and_enlarging_are_opencvs(sizes):
    rows, columns, height, width = sizes
    image = np.random.default_rng(rows).integers(0, 256, (height, width, 3), dtype=np.uint8)
    assert (
        np.abs(geometry.resize_bilinear(image, (rows, columns)).astype(int) - cv2.resize(image, (columns, rows))).max()
        <= 1
    )


@pytest.mark.parametrize(("size", "rule"), [((30, 31), cv2.INTER_LINEAR), ((31, 30), cv2.INTER_AREA)])
def test_the_new_width_against_the_old_height_chooses_the_rule(size, rule):
    image = FRAME.astype(np.float64)
    assert np.array_equal(geometry.resize_auto(image, size), cv2.resize(image, size[::-1], interpolation=rule))


def test_a_patch_of_the_right_size_is_not_resampled():
    assert np.array_equal(geometry.resize_auto(FRAME, FRAME.shape[:2]), FRAME)


def test_scale_limits_are_powers_of_the_step():
    low, high = geometry.scale_limits(1.02, (180, 123), (60, 41), (720, 1280))
    assert np.allclose([low, high], [1.02**-161, 1.02**125])
    assert geometry.clamp_scale(99, (low, high)) == high
    assert geometry.clamp_scale(0, (low, high)) == low
    assert geometry.clamp_scale(1.5, (low, high)) == 1.5


@pytest.mark.parametrize(("x", "grey"), [(0, True), (7, False)])
def test_a_frame_is_grey_if_red_and_green_are_equal(x, grey):
    frame = np.full((9, 9, 3), 5, np.uint8)
    frame[4, 4, 1] += x
    assert geometry.is_grey(frame) is grey


BOXES = [(400, 300, 41, 60), (400, 300, 22, 16), (400, 300, 188, 130)]
HD = np.random.default_rng(2).integers(0, 256, (720, 1280, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("box", "window", "cells"),
    [(BOXES[0], (150, 102), (37, 25)), (BOXES[1], (40, 55), (10, 13)), (BOXES[2], (162, 235), (40, 58))],
)
def test_windows_of_kcf(box, window, cells):
    filter_ = Kcf(HD, box, KcfConstants())
    assert tuple(filter_._window) == window
    assert filter_._cells == cells


@pytest.mark.parametrize(
    ("box", "window", "cells", "model"),
    [
        (BOXES[0], (180, 123), (45, 30), (27, 18)),
        (BOXES[1], (48, 66), (12, 16), (16, 22)),
        (BOXES[2], (390, 564), (97, 141), (18, 27)),
    ],
)
def test_windows_of_fdsst(box, window, cells, model):
    filter_ = Fdsst(HD, box, FdsstConstants())
    assert tuple(filter_._window) == window
    assert (filter_._cells, filter_._scales.model) == (cells, model)


@pytest.mark.parametrize(
    ("box", "background", "foreground", "normal", "cells", "target", "side"),
    [
        (BOXES[0], (110, 91), (50, 31), (176, 146), (44, 36), (96, 66), 81),
        (BOXES[1], (34, 40), (12, 18), (148, 174), (37, 43), (68, 94), 81),
        (BOXES[2], (288, 346), (98, 156), (146, 175), (36, 43), (66, 95), 81),
    ],
)
def test_areas_of_staple_ca(box, background, foreground, normal, cells, target, side):
    filter_ = StapleCa(HD, box, StapleCaConstants())
    areas, sizes = filter_._areas, filter_._normal
    assert (tuple(areas.background), tuple(areas.foreground)) == (background, foreground)
    assert (sizes.background, sizes.cells, tuple(sizes.target), filter_._side) == (normal, cells, target, side)


@pytest.mark.parametrize(
    ("box", "background", "normal", "cells", "target", "side"),
    [
        (BOXES[0], (136, 117), (162, 139), (40, 34), (87, 64), 139),
        (BOXES[1], (44, 50), (141, 160), (35, 40), (66, 85), 141),
        (BOXES[2], (368, 426), (139, 161), (34, 40), (64, 86), 139),
    ],
)
def test_areas_of_mcct_h(box, background, normal, cells, target, side):
    filter_ = McctH(HD, box, McctHConstants())
    sizes = filter_._normal
    assert tuple(filter_._areas.background) == background
    assert (sizes.background, sizes.cells, tuple(sizes.target), filter_._side) == (normal, cells, target, side)


def test_a_background_beyond_the_frame_is_capped():
    areas = staple.Rule((100, 300), 150**2, 1, 0.2).areas(np.array([90.0, 90.0]))
    assert tuple(areas.background) == (98, 180)

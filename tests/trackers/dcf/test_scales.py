"""The two scale filters: closed forms against dense least squares, and scales that are found again."""

import cv2
import numpy as np
import pytest

pytest.importorskip("scipy")
pytest.importorskip("numba")

from psiamfcpp.trackers.dcf.geometry import crop, resize_auto
from psiamfcpp.trackers.dcf.scales import (
    FastScaleConstants,
    FastScaleFilter,
    ScaleConstants,
    ScaleFilter,
    model_size,
    patch_features,
)

RNG = np.random.default_rng(5)
TEXTURE = cv2.GaussianBlur(RNG.integers(0, 256, (240, 320, 3), dtype=np.uint8), (0, 0), 2)
CENTRE = (121.0, 161.0)


def zoomed(factor):
    """The texture, larger by a factor about `CENTRE`."""
    x, y = CENTRE[1] - 1, CENTRE[0] - 1
    matrix = np.array([[factor, 0, x - factor * x], [0, factor, y - factor * y]])
    return cv2.warpAffine(TEXTURE, matrix, (320, 240), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def circulants(sample):
    """Every cyclic shift of each column of a sample ``(scales, values)``, side by side."""
    shifts = np.stack([np.roll(sample, -s, axis=0) for s in range(len(sample))])
    return np.concatenate(list(np.moveaxis(shifts, 2, 0)), axis=1)


def test_dssts_closed_form_is_the_ridge_regression_on_all_shifts():
    constants = ScaleConstants(num_scales=7, scale_sigma=1.1, scale_lambda=0.3)
    filter_ = ScaleFilter(constants, (16, 16))
    sample, new = RNG.normal(size=(2, 7, 4)).astype(np.float32)
    filter_.blend(sample)
    steps = np.arange(7) - 3
    label = np.exp(-(steps**2) / (2 * 1.1**2))
    rows = circulants(sample).astype(float)
    weights = np.linalg.solve(rows.T @ rows + 0.3 * np.eye(rows.shape[1]), rows.T @ label)
    assert np.allclose(filter_.response(new), circulants(new) @ weights, atol=1e-4)


@pytest.mark.parametrize("factor", [1.0, 1.04, 1.08, 0.96, 0.92])
def test_both_filters_find_a_changed_scale_again(factor):
    for filter_ in (ScaleFilter(ScaleConstants(), (40, 50)), FastScaleFilter(FastScaleConstants(), (40, 50))):
        filter_.train(TEXTURE, CENTRE, 1.0)
        assert filter_.follow(zoomed(factor), CENTRE, 1.0) == pytest.approx(factor, abs=0.025)


def test_both_filters_keep_the_scale_within_its_limits():
    for kind, constants in ((ScaleFilter, ScaleConstants()), (FastScaleFilter, FastScaleConstants())):
        filter_ = kind(constants, (40, 50), (0.99, 1.01))
        filter_.train(TEXTURE, CENTRE, 1.0)
        assert [filter_.follow(zoomed(f), CENTRE, 1.0) for f in (0.92, 1.08)] == [0.99, 1.01]


def test_a_parabola_finds_scales_between_the_steps():
    fast = FastScaleFilter(FastScaleConstants(do_poly_interp=True), (40, 50))
    fast.train(TEXTURE, CENTRE, 1.0)
    assert fast.follow(TEXTURE, CENTRE, 1.0) == pytest.approx(1, abs=0.005)
    assert fast.follow(zoomed(1.05), CENTRE, 1.0) == pytest.approx(1.05, abs=0.015)


@pytest.mark.parametrize("position", [(121.7, 161.2), (2.0, 3.0), (-40.0, 500.0)])
def test_patches_are_those_that_are_cut_one_by_one(position):
    from psiamfcpp.trackers.dcf.features import fhog

    sizes = np.array([[60, 40], [31, 25], [12, 9], [24, 16]])
    want = [fhog(resize_auto(crop(TEXTURE, position, s), (24, 16)), sse=True).ravel() for s in sizes]
    assert np.array_equal(patch_features(TEXTURE, position, sizes.astype(float), (24, 16)), want)


def test_decimation_reads_large_targets_at_every_second_pixel():
    fast = FastScaleFilter(FastScaleConstants(decimate=True), (40, 50))
    fast.train(TEXTURE, CENTRE, 3.0)
    assert fast.follow(TEXTURE, CENTRE, 3.0) == pytest.approx(3)


@pytest.mark.parametrize(
    ("size", "model"),
    [((60, 41), (27, 18)), ((16, 22), (16, 22)), ((130, 188), (18, 27)), ((3, 3), (4, 4)), ((2, 900), (4, 480))],
)
def test_models_hold_at_most_their_area_and_at_least_a_cell(size, model):
    assert model_size(size, 512) == model

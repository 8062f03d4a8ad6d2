from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiamfcpp.training import augment

CHANGES = [change for change, _ in augment._CHANGES]


@pytest.fixture
def image() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (90, 90, 3), dtype=np.uint8)


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_each_change_keeps_the_form_and_changes_the_pixels(image, change):
    before, same = image.copy(), 0
    for seed in range(8):
        changed = change(image, np.random.default_rng(seed))
        assert changed.shape == image.shape
        assert changed.dtype == np.uint8
        same += np.array_equal(changed, image)
        assert np.array_equal(changed, change(image, np.random.default_rng(seed)))
        assert np.array_equal(image, before), "the input must stay"
    assert same <= 1, "by chance, one may be too weak to show"


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_no_change_moves_what_is_shown(change):
    """A box label holds after every change: the bright middle stays where it is."""
    image = np.full((90, 90, 3), 60, dtype=np.uint8)
    image[30:60, 30:60] = 190
    for seed in range(8):
        changed = change(image, np.random.default_rng(seed)).astype(float).mean(axis=2)
        inside = np.zeros((90, 90), bool)
        inside[35:55, 35:55] = True
        outside = np.ones((90, 90), bool)
        outside[25:65, 25:65] = False
        assert np.percentile(changed[inside], 5) > np.percentile(changed[outside], 95)


def test_photometric_is_decided_by_the_generator(image):
    results = [augment.photometric(image, np.random.default_rng(seed)) for seed in (0, 0, 1, 2, 3)]
    assert np.array_equal(results[0], results[1])
    assert len({result.tobytes() for result in results}) > 2
    assert all(result.shape == image.shape and result.dtype == np.uint8 for result in results)


def test_strength_zero_changes_nothing(image):
    rng = np.random.default_rng(0)
    assert all(np.array_equal(augment.photometric(image, rng, 0.0), image) for _ in range(50))


def test_strength_is_a_matter_of_chance(image):
    def share(strength: float) -> float:
        rng = np.random.default_rng(0)
        return float(np.mean([augment.photometric(image, rng, strength) is not image for _ in range(60)]))

    assert share(0.2) < share(1.0) - 0.2


def test_grey_has_equal_channels(image):
    grey = augment.grey(image)
    assert grey.shape == image.shape
    assert (grey == grey[..., :1]).all()
    assert grey.std() > 0


@given(st.floats(-40, 120), st.floats(-40, 120), st.floats(0, 110), st.floats(0, 110), st.integers(0, 2**32 - 1))
def test_occlusion_stays_inside_the_target(x0: float, y0: float, w: float, h: float, seed: int):
    image = np.random.default_rng(0).integers(0, 256, (90, 90, 3), dtype=np.uint8)
    before = image.copy()
    covered = augment.occlude(image, (x0, y0, x0 + w, y0 + h), np.random.default_rng(seed))
    assert np.array_equal(image, before)
    rows, columns = np.nonzero((covered != image).any(axis=2))
    if len(rows):
        assert x0 - 1 < columns.min() and columns.max() <= x0 + w
        assert y0 - 1 < rows.min() and rows.max() <= y0 + h


@pytest.mark.parametrize("seed", range(6))
def test_occlusion_covers_a_fifth_to_a_half_of_one_side(image, seed: int):
    covered = augment.occlude(image, (20, 30, 60, 70), np.random.default_rng(seed))
    rows, columns = np.nonzero((covered != image).any(axis=2))
    sides = sorted((int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1))
    assert sides[1] == 40
    assert 0.2 * 40 - 1 <= sides[0] <= 0.5 * 40
    assert {20, 59} & {columns.min(), columns.max()} and {30, 69} & {rows.min(), rows.max()}


@pytest.mark.parametrize("corners", [(20, 20, 26, 26), (20, 20, 60, 23), (95, 95, 130, 130), (-50, 10, -5, 40)])
def test_targets_too_small_to_cover_stay(image, corners):
    for seed in range(10):
        assert augment.occlude(image, corners, np.random.default_rng(seed)) is image


def test_a_transplanted_target_keeps_its_middle_and_loses_its_surroundings() -> None:
    image, backdrop = np.full((100, 100, 3), 200, np.uint8), np.full((100, 100, 3), 20, np.uint8)
    moved = augment.transplant(image, (30, 40, 70, 60), backdrop)
    assert (moved[50, 50] == 200).all()
    assert (moved[[10, 50, 90], [50, 95, 10]] == 20).all()
    # The ellipse reaches a little beyond the sides of the box, and not into its corners.
    assert moved[50, 31, 0] > 110
    assert moved[41, 31, 0] < 60
    assert (image == 200).all()


def test_a_target_outside_the_crop_leaves_the_backdrop() -> None:
    image, backdrop = np.full((60, 60, 3), 200, np.uint8), np.full((60, 60, 3), 20, np.uint8)
    assert (augment.transplant(image, (200, 200, 240, 240), backdrop) == 20).all()


@pytest.mark.parametrize("corners", [(30, 40, 70, 60), (-20, 10, 30, 90), (80, 80, 130, 99), (49, 49, 50, 50)])
def test_a_transplanted_target_changes_nothing_far_from_its_box(corners) -> None:
    image, backdrop = np.full((100, 100, 3), 200, np.uint8), np.full((100, 100, 3), 20, np.uint8)
    rows, columns = np.nonzero((augment.transplant(image, corners, backdrop) != backdrop).any(axis=2))
    reach = 0.05 * (corners[2] - corners[0] + corners[3] - corners[1]) * 4 + 6
    assert len(rows)
    assert columns.min() >= corners[0] - reach and columns.max() <= corners[2] + reach
    assert rows.min() >= corners[1] - reach and rows.max() <= corners[3] + reach
    assert (backdrop == 20).all()


def test_noise_has_the_wanted_spread_and_no_bias(image) -> None:
    middling = np.full((300, 300, 3), 128, np.uint8)
    noises = [augment._noise(middling, np.random.default_rng(seed)).astype(float) - 128 for seed in range(30)]
    spreads = [noise.std() for noise in noises]
    assert min(spreads) > 1.9 and max(spreads) < 12.1
    assert abs(np.mean(noises)) < 0.2

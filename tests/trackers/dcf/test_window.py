"""Worked geometry of the square search windows, and their samples."""

from __future__ import annotations

import numpy as np
import pytest

from psiamfcpp.trackers.dcf import window
from psiamfcpp.trackers.dcf.bacf import BacfConstants
from psiamfcpp.trackers.dcf.strcf import StrcfConstants


@pytest.mark.parametrize(
    ("w", "h", "cell", "scale", "side", "cells", "small"),
    [
        (41, 60, 4, 1.239960, 200, 50, (12, 8)),
        (22, 16, 3, 1, 93, 31, (5, 7)),
        (188, 130, 4, 3.908324, 200, 50, (8, 12)),
    ],
)
def test_bacf_window(w, h, cell, scale, side, cells, small):
    c = BacfConstants()
    found = window.fixed_area_window(np.array([h, w], float), c.search_area_scale, c.hog_cell_size, c.filter_max_area)
    assert (found.cell, found.side, found.cells, found.small) == (cell, side, (cells, cells), small)
    assert found.scale == pytest.approx(scale, abs=1e-6)


@pytest.mark.parametrize(
    ("w", "h", "scale", "side", "cells", "small"),
    [
        (41, 60, 1.239960, 200, 50, (12, 8)),
        (22, 16, 0.625389, 152, 38, (6, 8)),
        (188, 130, 3.908324, 200, 50, (8, 12)),
    ],
)
def test_strcf_window(w, h, scale, side, cells, small):
    found = StrcfConstants().window(np.array([h, w], float))
    assert (found.side, found.cells, found.small) == (side, (cells, cells), small)
    assert found.scale == pytest.approx(scale, abs=1e-6)


@pytest.mark.parametrize("size", [(1, 1), (1, 400), (400, 1), (3, 3), (2000, 2000)])
def test_extreme_targets_keep_at_least_one_cell_inside_the_window(size):
    for found in (
        window.fixed_area_window(np.array(size, float), 5, 4, 2500),
        window.WindowConstants().window(np.array(size, float)),
    ):
        assert min(found.small) >= 1
        assert found.small[0] <= found.cells[0] and found.small[1] <= found.cells[1]
        assert found.side % found.cell == 0


def test_label_peaks_at_zero_shift_and_widens_with_the_target():
    narrow, wide = (
        window.WindowConstants().window(np.array([s, s], float)).label(f) for s, f in ((40, 1 / 16), (40, 1 / 8))
    )
    assert np.unravel_index(narrow.argmax(), narrow.shape) == (0, 0)
    assert narrow.max() == 1
    assert wide.sum() > narrow.sum()


def test_response_of_a_filter_equal_to_the_sample_is_its_energy():
    rng = np.random.default_rng(0)
    sample = (rng.standard_normal((1, 3, 4, 3)) + 1j * rng.standard_normal((1, 3, 4, 3))).astype(np.complex64)
    found = window.responses(sample[0], sample)
    assert found[0] == pytest.approx((np.abs(sample[0]) ** 2).sum(axis=0), rel=1e-5)


@pytest.mark.parametrize("grey", [False, True])
def test_features_have_the_authors_channels(grey):
    patch = np.random.default_rng(1).integers(0, 256, (24, 28, 3), np.uint8)
    assert window.grey_hog_names_of(grey)(patch, 4).shape == (32 if grey else 42, 6, 7)
    assert window.hog_of(grey)(patch, 4).shape == (31, 6, 7)

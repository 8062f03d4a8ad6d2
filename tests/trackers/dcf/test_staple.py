"""Colour histograms, likelihoods and responses of Staple-CA and MCCT-H; Staple-CA's closed form."""

import numpy as np
import pytest

pytest.importorskip("scipy")
pytest.importorskip("numba")

from psiamfcpp.trackers.dcf import staple
from psiamfcpp.trackers.dcf.fourier import irfft2, rfft2
from psiamfcpp.trackers.dcf.staple_ca import StapleCa, StapleCaConstants

RNG = np.random.default_rng(7)


@pytest.mark.parametrize("size", [(7, 9), (8, 10)])
def test_the_label_peaks_at_the_last_element(size):
    label = staple.label(size, 1.2)
    assert label[-1, -1] == label.max() == 1
    # at even sizes one row and one column stay zero
    assert [(label == 0).all(axis=a).sum() for a in (1, 0)] == [1 - n % 2 for n in size]


@pytest.mark.parametrize("size", [(19, 21), (20, 22)])
def test_a_response_without_shift_peaks_in_the_middle(size):
    side = 41
    pixels = staple.on_pixels(staple.label(size, 1.5)[None], side)[0]
    assert pixels.shape == (side, side)
    assert np.unravel_index(pixels.argmax(), pixels.shape) == (side // 2, side // 2)


def test_the_colours_of_the_target_are_likely():
    patch = np.full((40, 40, 3), 20, np.uint8)
    patch[12:28, 12:28] = (0, 0, 200)
    areas = staple.Rule((200, 200), 40**2, 1.5, 0.2).areas(np.array([16.0, 16.0]))
    colours = staple.Histograms()
    colours.update(patch, areas, 1.0)
    likelihood = colours.likelihood(patch)
    assert likelihood[20, 20] > 0.99
    assert likelihood[2, 2] < 0.01
    assert colours.likelihood(np.full((1, 1, 3), 255, np.uint8))[0, 0] == 0
    # a second patch counts by the learning rate
    colours.update(np.full_like(patch, 20), areas, 0.5)
    assert 0 < colours.likelihood(patch)[2, 2] < 0.5


def test_likelihood_of_the_centre_is_the_mean_of_each_window():
    likelihood = RNG.random((9, 12)).astype(np.float32)
    got = staple.centre_likelihood(likelihood, (4, 7))
    want = [[likelihood[y : y + 4, x : x + 7].mean() for x in range(6)] for y in range(6)]
    assert np.allclose(got, want, atol=1e-6)


def test_the_filter_with_context_is_the_dense_ridge_regression():
    """One channel: least squares on all shifts of the target to the label, of each context patch to zero."""
    frame = RNG.integers(0, 256, (90, 120, 3), dtype=np.uint8)
    filter_ = StapleCa(frame, (50, 40, 20, 16), StapleCaConstants(fixed_area=32**2, lambda_1=0.4))
    cells = filter_._normal.cells
    maps = RNG.normal(size=(5, 1, *cells)).astype(np.float32)
    filter_._spectra = lambda *_: (np.repeat(rfft2(maps), 28, axis=1), np.zeros((1, 32, 32, 3), np.uint8))
    numerator, denominator = filter_._train(frame)
    got = irfft2(28 * numerator[0] / denominator, cells)

    def shifts(one):
        return np.stack(
            [np.roll(one, (i, j), (0, 1)).ravel() for i in range(cells[0]) for j in range(cells[1])], axis=1
        )

    rows = np.concatenate([shifts(maps[0, 0]), *(np.sqrt(0.5) * shifts(m[0]) for m in maps[1:])])
    label = np.concatenate([irfft2(filter_._label, cells).ravel(), np.zeros(4 * np.prod(cells))])
    dense = np.linalg.solve(rows.T @ rows + 0.4 * np.eye(rows.shape[1]), rows.T @ label)
    assert np.allclose(got.ravel(), dense, atol=1e-4)

"""Labels, transforms and the peak between grid points."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("scipy")

from psiamfcpp.trackers.dcf import fourier

RNG = np.random.default_rng(4)
SIZES = [(8, 10), (7, 9), (6, 5), (1, 4), (5, 1)]


@pytest.mark.parametrize("size", SIZES)
def test_half_planes_hold_the_full_spectrum(size):
    maps = RNG.normal(size=(3, *size))
    half = fourier.rfft2(maps)
    assert np.allclose(fourier.full_plane(half, size[1]), fourier.fft2(maps))
    assert np.allclose(fourier.irfft2(half, size), maps)


@pytest.mark.parametrize("size", SIZES)
def test_the_label_peaks_at_the_first_element(size):
    label = fourier.label(size, 1.3)
    assert label[0, 0] == 1
    assert fourier.argmax2(label) == (0, 0)
    # cyclic distance in both directions
    assert np.allclose(label[1:], label[1:][::-1])


@pytest.mark.parametrize("n", [1, 2, 5, 6])
def test_offsets_are_the_signed_distances_on_a_ring(n):
    assert fourier.offsets(n).tolist() == [((i + (n - 1) // 2) % n) - (n - 1) // 2 for i in range(n)]


def test_of_equal_maxima_the_first_by_columns_counts():
    response = np.zeros((3, 3))
    response[0, 2] = response[2, 1] = 1
    assert fourier.argmax2(response) == (2, 1)


@given(st.floats(-3.4, 3.4), st.floats(-4.4, 4.4), st.sampled_from([(20, 25), (21, 24)]))
def test_newtons_method_finds_a_peak_between_grid_points(y, x, size):
    ky, kx = (fourier.offsets(n) for n in size)
    # a smooth bump at (y, x), given by its spectrum, whose Nyquist terms vanish
    bump = np.exp(-(ky[:, None] ** 2 + kx**2) / 8) * np.exp(
        -2j * np.pi * (ky[:, None] * y / size[0] + kx * x / size[1])
    )
    weak = 0.5 * np.exp(-(ky[:, None] ** 2 + kx**2) / 8)
    shift, scale, value = fourier.newton_peak(np.stack([weak, bump]), 50)
    assert scale == 1
    assert np.allclose(shift, (y, x), atol=1e-6)
    assert value == pytest.approx(np.abs(bump).sum() / np.prod(size), rel=1e-6)


def test_a_peak_that_newtons_method_loses_is_that_of_the_grid():
    shift, scale, value = fourier.newton_peak(np.zeros((2, 6, 7), np.complex64), 5)
    assert (shift.tolist(), scale, value) == ([0, 0], 0, 0)


@pytest.mark.parametrize("size", [(9, 7), (8, 6), (9, 6)])
def test_a_finer_grid_keeps_the_values_of_a_smooth_map(size):
    y, x = (2 * np.pi * np.arange(n) / n for n in size)
    maps = 1 + np.cos(2 * y)[:, None] * np.sin(x) + np.sin(y)[:, None]
    fine = fourier.irfft2_finer(fourier.rfft2(maps), size, 4)
    assert fine.shape == (4 * size[0], 4 * size[1])
    assert np.allclose(fine[::4, ::4], maps)


def test_a_phase_shift_moves_a_map():
    maps = RNG.normal(size=(9, 7))
    moved = fourier.ifft2(fourier.fft2(maps) * fourier.phase_shift((9, 7), 2 * np.pi * np.array([2 / 9, -1 / 7])))
    assert np.allclose(moved.real, np.roll(maps, (-2, 1), axis=(0, 1)))


@pytest.mark.parametrize("inner", [False, True])
def test_hann_windows(inner):
    window = fourier.hann2((5, 6), inner)
    i = np.arange(5)
    want = 0.5 * (1 - np.cos(2 * np.pi * (i + 1) / 6)) if inner else 0.5 * (1 - np.cos(2 * np.pi * i / 4))
    assert np.allclose(window[:, 2] / window[:, 2].max(), want / want.max())

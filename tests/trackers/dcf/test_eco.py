"""ECO's parts against direct calculations on small problems."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from psiamfcpp.trackers.dcf import eco
from psiamfcpp.trackers.dcf.eco_hc import principal_axes, sample_patch, window_side
from psiamfcpp.trackers.dcf.scales import parabola


def half_plane(seed: int, channels: int, n: int) -> np.ndarray:
    """Spectrum of real maps on an odd grid."""
    maps = np.random.default_rng(seed).standard_normal((channels, n, n)).astype(np.float32)
    return eco.centred(maps)


def full_centred(half: np.ndarray) -> np.ndarray:
    """Full plane with frequency 0 in the middle."""
    return np.fft.fftshift(eco.complete(half))


def test_centred_and_complete_give_the_plain_spectrum_on_an_odd_grid():
    maps = np.random.default_rng(0).standard_normal((7, 7))
    assert eco.complete(eco.centred(maps)) == pytest.approx(np.fft.fft2(maps), abs=1e-12)


def test_even_grid_is_extended_to_an_odd_one():
    maps = np.random.default_rng(1).standard_normal((2, 6, 6))
    found = eco.centred(maps)
    assert found.shape == (2, 7, 4)
    want = np.fft.fft2(maps)
    for row, frequency in enumerate(range(-3, 4)):
        assert found[:, row, 1] == pytest.approx(want[:, frequency, 1])


@pytest.mark.parametrize("f", [0.0, 0.05, 0.3, 0.5, 1.2])
def test_cubic_kernel_is_the_transform_of_the_kernel(f):
    a = -0.75
    t = np.linspace(-2, 2, 40001)
    u = np.abs(t)
    near = (a + 2) * u**3 - (a + 3) * u**2 + 1
    far = a * u**3 - 5 * a * u**2 + 8 * a * u - 4 * a
    kernel = np.where(u <= 1, near, far)
    want = np.trapezoid(kernel * np.cos(2 * np.pi * f * t), t)
    assert eco.cubic_kernel(np.array([f]), a)[0] == pytest.approx(want, abs=1e-6)


def test_interpolated_sample_goes_through_the_samples():
    n, sample = 15, np.random.default_rng(2).standard_normal(15)
    smooth = np.convolve(np.tile(sample, 3), np.hanning(7) / 3, "same")[n : 2 * n]
    factor = eco.interpolation(n, -0.75)[:, 0]
    spectrum = np.fft.fftshift(np.fft.fft(smooth)) * factor / (n * factor[n // 2])
    k = np.arange(-7, 8)
    values = [(spectrum * np.exp(2j * np.pi * k * (i + 0.5) / n)).sum().real for i in range(n)]
    assert values == pytest.approx(smooth, abs=0.1 * np.ptp(smooth))


def test_label_is_the_transform_of_a_periodic_gaussian():
    n, sigma = 21, 0.08
    t = np.arange(400) / 400
    wrapped = sum(np.exp(-((t - p) ** 2) / (2 * sigma**2)) for p in range(-3, 4))
    want = np.fft.fft(wrapped) / 400
    assert eco.label(n, sigma)[10] == pytest.approx((want[0] * want[: n // 2 + 1]).real, abs=1e-6)


def test_shift_moves_the_content():
    n = 9
    maps = np.random.default_rng(3).standard_normal((n, n))
    moved = eco.complete(eco.centred(maps) * eco.shift(n, 2 * np.pi * np.array([2, -1]) / n))
    assert np.fft.ifft2(moved).real == pytest.approx(np.roll(maps, (-2, 1), axis=(0, 1)), abs=1e-5)


def test_inner_is_that_of_the_full_planes():
    a, b = half_plane(4, 3, 7), half_plane(5, 3, 7)
    want = sum(np.vdot(eco.complete(x), eco.complete(y)).real for x, y in zip(a, b, strict=True))
    assert eco.inner(a, b) == pytest.approx(want, rel=1e-5)


def test_merge_adds_the_smaller_block_in_the_middle():
    large, small = half_plane(6, 1, 9)[0], half_plane(7, 1, 5)[0]
    total = full_centred(eco.merge([large, small], 9))
    want = full_centred(large)
    want[2:7, 2:7] += full_centred(small)
    assert total == pytest.approx(want, abs=1e-4)


@pytest.mark.parametrize(("side", "base"), [(60, (15.0, 15.0)), (61, (8.0, 25.0)), (48, (20.0, 6.5))])
def test_regulariser_is_the_double_convolution_with_the_sparse_window(side, base):
    edge, least, sparsity = 1e-2, 1e-4, 0.05
    y, x = np.mgrid[:side, :side] - (side - 1) / 2
    w = (edge - least) * ((y / (base[0] / 2)) ** 2 + (x / (base[1] / 2)) ** 2) + least
    spectrum = np.fft.fft2(w) / side**2
    spectrum[np.abs(spectrum) < sparsity * np.abs(spectrum).max()] = 0
    spectrum[0, 0] += least - side**2 * np.fft.ifft2(spectrum).real.min()
    spectrum = np.fft.fftshift(spectrum)
    kernel = spectrum[~(spectrum == 0).all(axis=1)][:, ~(spectrum == 0).all(axis=0)].real

    regulariser = eco.Regulariser(side, np.array(base), edge, least, sparsity)
    assert regulariser.energy == pytest.approx((kernel**2).sum(), rel=1e-6)
    f = half_plane(8, 2, 13)
    found = regulariser.operator(13)(f)
    for channel in range(2):
        once = scipy.signal.convolve2d(full_centred(f[channel]), kernel, "full")
        twice = scipy.signal.convolve2d(once, kernel, "valid")
        assert full_centred(found[channel]) == pytest.approx(twice, abs=1e-5 * np.abs(twice).max())


@pytest.mark.parametrize("fletcher_reeves", [True, False])
def test_conjugate_gradients_solve_a_small_system(fletcher_reeves):
    rng = np.random.default_rng(9)
    root = rng.standard_normal((6, 6))
    matrix, right = root @ root.T + np.eye(6), rng.standard_normal(6)
    diagonal = np.diag(matrix)
    errors = []
    want = np.linalg.solve(matrix, right)
    for iterations in (1, 3, 12):
        found, _ = eco.conjugate_gradients(
            lambda v: [matrix @ v[0]],
            [right],
            lambda v: [v[0] / diagonal],
            lambda a, b: float(a[0] @ b[0]),
            [np.zeros(6)],
            iterations,
            fletcher_reeves=fletcher_reeves,
        )
        errors.append(np.abs(found[0] - want).max())
    assert errors[2] < errors[1] < errors[0]
    assert errors[2] < 1e-3


def test_conjugate_gradients_stop_at_the_solution():
    found, momentum = eco.conjugate_gradients(
        lambda v: v, [np.zeros(3)], lambda v: v, lambda a, b: float(a[0] @ b[0]), [np.zeros(3)], 5
    )
    assert (found[0] == 0).all()
    assert momentum is None


class TestSampleSpace:
    def space(self, count: int, size: int = 4, rate: float = 0.1) -> eco.SampleSpace:
        space = eco.SampleSpace(size, rate)
        for seed in range(count):
            space.add([half_plane(seed, 2, 5)])
        return space

    def test_weights_sum_to_one_and_the_first_is_the_heaviest(self):
        space = self.space(3)
        blocks, weights = space.samples()
        assert len(blocks[0]) == 3
        assert weights == pytest.approx([0.81, 0.09, 0.1])

    def test_full_memory_merges_the_nearest_pair(self):
        space = self.space(3)
        space.add([half_plane(1, 2, 5)])  # the same as the second
        held = space.weights.copy()
        space.add([half_plane(20, 2, 5)])
        assert space.weights.sum() == pytest.approx(1)
        assert space.weights.max() == pytest.approx(held[0] * 0.9)
        assert sorted(space.weights)[:2] == pytest.approx(sorted([held[2] * 0.9, 0.1]))
        assert sum(np.allclose(sample, half_plane(1, 2, 5)) for sample in space.blocks[0]) == 1

    def test_full_memory_merges_a_new_sample_into_a_near_one(self):
        space = self.space(4)
        held = space.weights.copy()
        new = half_plane(2, 2, 5) * np.float32(1.01)
        space.add([new])
        assert space.weights[2] == pytest.approx(held[2] * 0.9 + 0.1)
        share = held[2] * 0.9 / (held[2] * 0.9 + 0.1)
        assert space.blocks[0][2] == pytest.approx(half_plane(2, 2, 5) * share + new * (1 - share), rel=1e-5)

    def test_outdated_sample_is_replaced(self):
        space = self.space(4)
        space.weights[:] = [0.6, 1e-4, 0.2, 0.1999]
        space.add([half_plane(30, 2, 5)])
        assert space.weights[1] == pytest.approx(0.1)
        assert space.weights.sum() == pytest.approx(1)
        assert space.blocks[0][1] == pytest.approx(half_plane(30, 2, 5))

    def test_many_samples_keep_weights_and_products_consistent(self):
        space = self.space(40)
        assert space.weights.sum() == pytest.approx(1)
        flat = space.blocks[0].reshape(4, -1)
        want = 2 * (flat.conj() @ flat.T).real
        assert space._gram == pytest.approx(want, rel=1e-3)


@pytest.mark.parametrize(("side", "want"), [(198.4, 212), (150, 164), (200, 212)])
def test_window_sides_of_the_authors(side, want):
    assert window_side(side, 6, 4) == want


def test_sample_patch_reads_every_nth_pixel_of_a_large_target():
    y, x = np.mgrid[:300, :400]
    frame = np.stack([y // 2, x // 2, 0 * x], axis=2).astype(np.uint8)
    patch = sample_patch(frame, np.array([151.0, 201.0]), 2.2, 50).astype(float)
    assert patch.shape == (50, 50, 3)
    assert patch[25, 25] == pytest.approx([75, 100, 0], abs=2)
    assert np.ptp(patch[:, 25, 0]) == pytest.approx(2.2 * 49 / 2, abs=2)


def test_principal_axes_find_the_direction_of_most_variance():
    rng = np.random.default_rng(10)
    axis = np.array([0.6, 0.8, 0.0])
    maps = 5 + axis[:, None] * rng.standard_normal(64) + 0.01 * rng.standard_normal((3, 64))
    found = principal_axes(maps.reshape(3, 8, 8).astype(np.float32), 1)
    assert abs(found[:, 0] @ axis) == pytest.approx(1, abs=1e-3)


def test_parabola_of_scales_has_its_vertex_at_the_maximum():
    x = 1.02 ** np.array([-1.0, 0.0, 1.0])
    y = (0.9 - 40 * (x - 1.004) ** 2).astype(np.float32)
    a, b = parabola(x, y)
    assert a < 0
    # The single precision of the authors leaves a part of a step open.
    assert -b / (2 * a) == pytest.approx(1.004, abs=5e-3)

"""KCF: its kernel and its closed form against dense ones, and the halved frame of large targets."""

import numpy as np
import pytest

pytest.importorskip("scipy")
pytest.importorskip("numba")

from psiamfcpp.trackers.dcf import kcf
from psiamfcpp.trackers.dcf.fourier import irfft2, rfft2

RNG = np.random.default_rng(6)
FRAME = RNG.integers(0, 256, (60, 80, 3), dtype=np.uint8)


@pytest.fixture
def small():
    # 4 x 5 cells
    return kcf.Kcf(FRAME, (30, 20, 8, 7), kcf.KcfConstants())


def shifts(maps):
    rows, columns = maps.shape[1:]
    return np.stack([np.roll(maps, (-i, -j), (1, 2)).ravel() for i in range(rows) for j in range(columns)])


def test_the_kernel_is_that_of_every_shift_and_alpha_solves_the_dense_system(small):
    x, z = (irfft2(s, small._cells).astype(float) for s in (small._model, rfft2(RNG.normal(size=(31, *small._cells)))))
    width = 0.25 * z.size
    dense = np.exp(-np.square(shifts(z)[:, None] - shifts(x)[None]).sum(axis=2) / width)
    got = irfft2(small._kernel(rfft2(z.astype(np.float32)), small._model), small._cells)
    assert np.allclose(got.ravel(), dense[:, 0], atol=1e-5)
    gram = np.exp(-np.square(shifts(x)[:, None] - shifts(x)[None]).sum(axis=2) / width)
    label = irfft2(small._label, small._cells).ravel()
    alpha = np.linalg.solve(gram + 1e-4 * np.eye(len(gram)), label)
    # close to singular: compare what the dual coefficients predict, not themselves
    response = irfft2(small._alpha * small._kernel(rfft2(z.astype(np.float32)), small._model), small._cells)
    assert np.allclose(response.ravel(), dense @ alpha, atol=2e-3)


def _halved(grey):
    """MATLAB's imresize(grey, 0.5): bicubic, stretched by two, mirrored border, rounded after each pass."""

    def cubic(x):
        x = np.abs(x)
        inner, outer = 1.5 * x**3 - 2.5 * x**2 + 1, -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2
        return np.where(x <= 1, inner, np.where(x <= 2, outer, 0))

    for axis in (0, 1):
        n = grey.shape[axis]
        matrix = np.zeros(((n + 1) // 2, n))
        for i in range(len(matrix)):
            for j in range(2 * i - 4, 2 * i + 6):
                mirrored = np.r_[0:n, n - 1 : -1 : -1][j % (2 * n)]
                matrix[i, mirrored] += 0.5 * cubic((2 * i + 0.5 - j) / 2)
        grey = np.moveaxis(np.tensordot(matrix, grey.astype(float), (1, axis)), 0, axis)
        grey = np.clip(np.floor(grey + 0.5), 0, 255)
    return grey


@pytest.mark.parametrize("shape", [(40, 50), (41, 37)])
@pytest.mark.parametrize("position", [(10, 12), (1, 1), (19, 24), (-30, 60)])
def test_the_part_of_a_halved_frame_is_that_of_the_whole(shape, position):
    frame = RNG.integers(0, 256, (*shape, 3), dtype=np.uint8)
    whole = _halved(kcf.grey(frame))
    got = kcf._crop_halved(frame, np.array(position, float), np.array([13.0, 10.0]))
    assert np.array_equal(got, kcf.crop(whole, position, (13, 10)))

"""The shared ADMM loop against dense solutions of tiny problems."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.fft

from psiamfcpp.trackers.dcf import admm

CELLS = (5, 4)
COUNT = CELLS[0] * CELLS[1]
CHANNELS = 2


def sample(seed: int, transform: admm.Transform = admm.REAL) -> admm.Spectrum:
    space = np.random.default_rng(seed).standard_normal((CHANNELS, *CELLS)).astype(np.float32)
    return transform.forward(space)


def gaussian() -> np.ndarray:
    rows, cols = (np.minimum(np.arange(n), n - np.arange(n)) for n in CELLS)
    return np.exp(-(rows[:, None] ** 2 + cols**2) / 2.0)


def space_of(f: admm.Spectrum, transform: admm.Transform = admm.REAL) -> np.ndarray:
    return np.real(transform.inverse(f.copy(), CELLS))


def dense_operator(x: admm.Spectrum) -> np.ndarray:
    """The matrix ``(cells, channels·cells)`` that takes a filter in space to its response to ``x`` in space."""
    columns = []
    for channel in range(CHANNELS):
        for cell in range(COUNT):
            f = np.zeros((CHANNELS, COUNT))
            f[channel, cell] = 1
            spectrum = scipy.fft.rfft2(f.reshape(CHANNELS, *CELLS))
            columns.append(scipy.fft.irfft2((spectrum.conj() * x).sum(axis=0), s=CELLS).ravel())
    return np.stack(columns, axis=1)


def dense_filter(x: admm.Spectrum, weights: np.ndarray, mu: float = 0.0, previous: np.ndarray | None = None):
    """Minimiser of ``½|A f − y|² + T/2·Σ weights f² + T·μ/2·|f − previous|²`` over filters in space."""
    a = dense_operator(x)
    keep = np.full(CHANNELS * COUNT, COUNT * mu) + COUNT * np.tile(weights.ravel(), CHANNELS)
    right = a.T @ gaussian().ravel()
    if previous is not None:
        right += COUNT * mu * previous.ravel()
    return np.linalg.solve(a.T @ a + np.diag(keep), right).reshape(CHANNELS, *CELLS)


@pytest.mark.parametrize("transform", [admm.REAL, admm.COMPLEX], ids=["half", "full"])
def test_first_iteration_is_ridge_regression(transform):
    x = sample(0, transform)
    scheme = admm.Scheme((0.3,), weights=lambda penalty: np.ones(CELLS, np.float32), transform=transform)
    label = transform.forward(gaussian())
    f = admm.solve(x, label, scheme, CELLS)
    want = dense_filter(sample(0), np.full(CELLS, 0.3))
    assert space_of(f, transform) == pytest.approx(want, abs=1e-5)


def test_previous_filter_pulls():
    x = sample(1)
    previous = sample(2)
    scheme = admm.Scheme((0.5,), weights=lambda penalty: np.ones(CELLS, np.float32))
    temporal = admm.Temporal(previous, lambda f: 2.0)
    f = admm.solve(x, admm.REAL.forward(gaussian()), scheme, CELLS, temporal)
    want = dense_filter(x, np.full(CELLS, 0.5), 2.0, space_of(previous))
    assert space_of(f) == pytest.approx(want, abs=1e-5)


def test_echo_solves_the_linear_system_at_every_frequency():
    x = sample(3, admm.COMPLEX)
    label = admm.COMPLEX.forward(gaussian())
    echo = np.random.default_rng(4).standard_normal(CELLS).astype(np.float32)
    gamma = 0.71
    scheme = admm.Scheme((0.4,), weights=lambda penalty: np.ones(CELLS, np.float32), transform=admm.COMPLEX)
    f = admm.solve(x, label, scheme, CELLS, echo=(echo, gamma))
    for row, col in np.ndindex(CELLS):
        v = x[:, row, col].astype(np.complex128)
        left = (1 + gamma) / COUNT * np.outer(v, v.conj()) + 0.4 * np.eye(CHANNELS)
        right = v * (label[row, col] / COUNT + gamma * echo[row, col])
        # The sample and the filter carry the same gain in front of xᴴf, so the same solve gives the closed form.
        assert f[:, row, col] == pytest.approx(np.linalg.solve(left, right), abs=1e-5)


def test_many_iterations_reach_the_dense_solution_with_spatial_weights():
    x = sample(5)
    window = np.where(admm.rectangle(CELLS, (3, 2)), 0.1, 3.0)
    scheme = admm.Scheme((1.0,) * 400, weights=lambda g: (1 / (window**2 + g)).astype(np.float32))
    f = admm.solve(x, admm.REAL.forward(gaussian()), scheme, CELLS)
    assert space_of(f) == pytest.approx(dense_filter(x, window**2), abs=2e-4)


def test_many_iterations_reach_the_dense_solution_with_window_and_previous_filter():
    x, previous = sample(6), sample(7)
    window = np.where(admm.rectangle(CELLS, (3, 2)), 0.1, 3.0)
    scheme = admm.Scheme((1.0,) * 400, weights=lambda g: (1 / (window**2 + g)).astype(np.float32))
    temporal = admm.Temporal(previous, lambda f: 0.7)
    f = admm.solve(x, admm.REAL.forward(gaussian()), scheme, CELLS, temporal)
    assert space_of(f) == pytest.approx(dense_filter(x, window**2, 0.7, space_of(previous)), abs=2e-4)


@pytest.mark.parametrize("transform", [admm.REAL, admm.COMPLEX], ids=["half", "full"])
def test_energy_outside_the_mask_falls_with_every_iteration(transform):
    x = sample(8, transform)
    mask = admm.rectangle(CELLS, (3, 2))
    schedule = admm.penalties(1, 10, 1e4, 5)
    outside = []
    for iterations in range(1, 6):
        scheme = admm.Scheme(schedule[:iterations], admm.constrained(mask, 0.01), transform)
        f = space_of(admm.solve(x, transform.forward(gaussian()), scheme, CELLS), transform)
        outside.append(np.sqrt((f[:, ~mask] ** 2).sum() / (f**2).sum()))
    assert all(later < earlier for earlier, later in itertools.pairwise(outside))
    assert outside[-1] < 0.01


def test_scaled_multiplier_changes_the_third_iteration_first():
    x = sample(9)
    weights = admm.constrained(admm.rectangle(CELLS, (3, 2)), 0.01)
    label = admm.REAL.forward(gaussian())
    for iterations, same in ((1, True), (2, True), (3, False)):
        schedule = admm.penalties(1, 10, 1e4, iterations)
        plain = admm.solve(x, label, admm.Scheme(schedule, weights), CELLS)
        scaled = admm.solve(x, label, admm.Scheme(schedule, weights, scaled_multiplier=True), CELLS)
        assert np.allclose(plain, scaled, atol=1e-7) is same


@pytest.mark.parametrize(
    ("first", "factor", "largest", "iterations", "want"),
    [
        (1, 10, 1e4, 2, (1, 10)),
        (1, 10, 1e4, 6, (1, 10, 100, 1000, 1e4, 1e4)),
        (1, 10, 0.1, 2, (1, 0.1)),
        (1, 10, 1e4, 1, (1,)),
    ],
)
def test_penalties(first, factor, largest, iterations, want):
    assert admm.penalties(first, factor, largest, iterations) == pytest.approx(want)


@pytest.mark.parametrize(
    ("cells", "small", "corner"),
    [((50, 50), (12, 8), (19, 21)), ((38, 38), (6, 8), (16, 15)), ((31, 31), (5, 7), (13, 12))],
)
def test_rectangle_has_the_target_size_and_the_authors_corner(cells, small, corner):
    mask = admm.rectangle(cells, small)
    rows, cols = np.nonzero(mask)
    assert (rows.min(), cols.min()) == corner
    assert (np.ptp(rows) + 1, np.ptp(cols) + 1) == small
    assert mask.sum() == small[0] * small[1]


def test_energy_and_correlate_agree_with_their_definitions():
    a, b = sample(10), sample(11)
    assert admm.energy(a) == pytest.approx((np.abs(a) ** 2).sum(axis=0), rel=1e-5)
    assert admm.correlate(a, b) == pytest.approx((a.conj() * b).sum(axis=0), rel=1e-5)

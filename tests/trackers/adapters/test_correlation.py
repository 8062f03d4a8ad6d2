from __future__ import annotations

import numpy as np
import pytest

from psiamfcpp.trackers.adapters.correlation import correlate

torch = pytest.importorskip("torch")


@pytest.mark.parametrize(("kernel", "patch"), [(1, 3), (3, 5), (3, 1)])
def test_correlation_by_its_definition(kernel: int, patch: int) -> None:
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, 2, 3, 6, 5))
    found = correlate(torch.tensor(first), torch.tensor(second), kernel, patch).numpy()
    assert found.shape == (2, patch, patch, 6, 5)

    def at(maps: np.ndarray, y: int, x: int) -> np.ndarray:
        inside = 0 <= y < 6 and 0 <= x < 5
        return maps[:, :, y, x] if inside else np.zeros((2, 3))

    half, reach = kernel // 2, patch // 2
    for row, column, y, x in np.ndindex(patch, patch, 6, 5):
        total = np.zeros(2)
        for i, j in np.ndindex(kernel, kernel):
            v, u = y + i - half, x + j - half
            total += (at(first, v, u) * at(second, v + row - reach, u + column - reach)).sum(axis=1)
        assert found[:, row, column, y, x] == pytest.approx(total)

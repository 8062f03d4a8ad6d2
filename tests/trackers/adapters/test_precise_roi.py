from __future__ import annotations

import sys

import numpy as np
import pytest

from psiamfcpp.trackers.adapters import precise_roi

torch = pytest.importorskip("torch")


def bilinear(feature: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Interpolate between pixels; outside of the feature map it is zero."""
    height, width = feature.shape
    total = np.zeros(np.broadcast(x, y).shape)
    for row in range(height):
        for column in range(width):
            total += feature[row, column] * np.clip(1 - abs(x - column), 0, None) * np.clip(1 - abs(y - row), 0, None)
    return total


@pytest.mark.parametrize(
    "box", [(4.0, 6.0, 20.0, 30.0), (-8.0, -8.0, 9.0, 12.0), (25.0, 10.0, 60.0, 33.0), (9.0, 9.0, 9.5, 11.0)]
)
def test_a_bin_is_the_mean_of_the_interpolated_features(box: tuple[float, ...]) -> None:
    rng = np.random.default_rng(1)
    features = rng.normal(size=(2, 3, 6, 5))
    rois = torch.tensor([[1.0, *box]], dtype=torch.float64)
    pooled = precise_roi.prroi_pool2d(torch.tensor(features), rois, 2, 3, 0.125)[0].numpy()
    x0, y0, x1, y1 = (value * 0.125 for value in box)
    # many points in the middle of small squares stand for the integral
    points = (np.arange(200) + 0.5) / 200
    for row in range(2):
        for column in range(3):
            y = y0 + (y1 - y0) * (row + points[:, None]) / 2
            x = x0 + (x1 - x0) * (column + points) / 3
            expected = [bilinear(feature, x, y).mean() for feature in features[1]]
            assert pooled[:, row, column] == pytest.approx(expected, abs=2e-4)


def test_an_empty_box_gives_zeros_and_no_nan() -> None:
    features = torch.ones(1, 2, 4, 4, requires_grad=True)
    rois = torch.tensor([[0.0, 8.0, 8.0, 8.0, 20.0], [0.0, 20.0, 8.0, 4.0, 20.0]])
    pooled = precise_roi.prroi_pool2d(features, rois, 2, 2, 0.125)
    pooled.sum().backward()
    assert (pooled == 0).all()
    assert torch.isfinite(features.grad).all()


@pytest.mark.slow
def test_boxes_have_the_gradient_that_their_refinement_follows() -> None:
    features = torch.rand(1, 2, 6, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    box = torch.tensor([[4.3, 6.1, 30.2, 33.7]], dtype=torch.float64, requires_grad=True)
    index = torch.zeros(1, 1, dtype=torch.float64)

    def pool(corners: torch.Tensor) -> torch.Tensor:
        return precise_roi.prroi_pool2d(features, torch.cat([index, corners], dim=1), 3, 3, 0.125)

    assert torch.autograd.gradcheck(pool, (box,))


def test_it_stands_in_for_the_compiled_extension(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("stand.in.outer", "stand.in.outer.prroi"):
        monkeypatch.setitem(sys.modules, name, None)
    precise_roi.offer("stand.in.outer.prroi", "cpu")
    module = sys.modules["stand.in.outer.prroi"]
    features, rois = torch.rand(1, 2, 6, 6), torch.tensor([[0.0, 4.0, 6.0, 30.0, 33.0]])
    layer = module.PrRoIPool2D(3, 3, 1 / 8)
    assert (layer(features, rois) == module.prroi_pool2d(features, rois, 3, 3, 1 / 8)).all()

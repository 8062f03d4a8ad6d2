from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from psiamfcpp.training.losses import focal_loss, iou, losses
from psiamfcpp.training.options import LossWeights
from psiamfcpp.training.targets import Targets, assign


@pytest.mark.parametrize(
    ("logit", "positive", "alpha", "gamma", "expected"),
    [
        (0.0, True, 0.25, 2, 0.25 * 0.5**2 * math.log(2)),
        (0.0, False, 0.25, 2, 0.75 * 0.5**2 * math.log(2)),
        (math.log(3), True, 0.25, 2, 0.25 * 0.25**2 * -math.log(0.75)),
        (math.log(3), False, 0.25, 2, 0.75 * 0.75**2 * -math.log(0.25)),
        (math.log(3), True, 0.5, 0, 0.5 * -math.log(0.75)),
        (50.0, True, 0.25, 2, 0.0),
        (-100.0, True, 0.25, 2, 25.0),
    ],
)
def test_focal_loss_of_one_cell(logit: float, positive: bool, alpha: float, gamma: float, expected: float):
    loss = focal_loss(torch.tensor([logit]), torch.tensor([positive]), alpha, gamma)
    assert loss.item() == pytest.approx(expected, rel=1e-5, abs=1e-12)


@pytest.mark.parametrize(
    ("predicted", "wanted", "expected"),
    [
        ((2, 2, 2, 2), (2, 2, 2, 2), 1.0),
        ((1, 1, 1, 1), (2, 2, 2, 2), 4 / 16),
        ((4, 2, 0, 2), (2, 2, 2, 2), 8 / 24),
        ((1, 2, 3, 4), (2, 1, 1, 6), (1 + 1) * (1 + 4) / (24 + 21 - 10)),
        ((0, 0, 0, 0), (2, 2, 2, 2), 0.0),
    ],
)
def test_iou_of_boxes_about_one_point(predicted, wanted, expected: float):
    one, other = (torch.tensor(d, dtype=torch.float32) for d in (predicted, wanted))
    assert iou(one, other).item() == pytest.approx(expected)
    assert iou(other, one).item() == pytest.approx(expected)


def label(present: bool = True, batch: int = 1) -> Targets:
    box = torch.tensor([[131.0, 141.0, 171.0, 161.0]]).expand(batch, -1)
    return assign(box, torch.tensor([present] * batch), 303, 17)


def test_perfect_maps_cost_nothing_but_the_entropy_of_centerness():
    targets = label()
    q = targets.centerness[targets.positive]
    maps = (
        torch.where(targets.positive, 30.0, -30.0),
        torch.logit(targets.centerness, eps=1e-6),
        targets.distances.clone(),
    )
    parts = losses(maps, targets, LossWeights())
    assert parts["cls"].item() == pytest.approx(0, abs=1e-9)
    assert parts["iou"].item() == pytest.approx(0, abs=1e-6)
    entropy = -(torch.xlogy(q, q) + torch.xlogy(1 - q, 1 - q)).mean()
    assert parts["centerness"].item() == pytest.approx(entropy.item(), rel=1e-3)


def test_overlap_is_weighted_by_centerness():
    positive = torch.tensor([[[True, True, False]]])
    wanted = torch.full((1, 1, 3, 4), 2.0)
    predicted = wanted.clone()
    predicted[0, 0, 0] = 1.0  # an overlap of 1/4
    targets = Targets(positive, torch.tensor([[[1.0, 0.25, 0.0]]]), wanted)
    parts = losses((torch.zeros(1, 1, 3), torch.zeros(1, 1, 3), predicted), targets, LossWeights())
    assert parts["iou"].item() == pytest.approx(math.log(4) / 1.25)
    assert parts["centerness"].item() == pytest.approx(math.log(2))
    assert parts["cls"].item() == pytest.approx((0.25 + 0.25 + 0.75) * 0.25 * math.log(2) / 2)


def test_the_total_is_the_weighted_sum():
    generator = torch.Generator().manual_seed(0)
    maps = (
        torch.randn(1, 17, 17, generator=generator),
        torch.randn(1, 17, 17, generator=generator),
        torch.rand(1, 17, 17, 4, generator=generator) * 40,
    )
    parts = losses(maps, label(), LossWeights(cls_weight=2, centerness_weight=3, iou_weight=5))
    expected = 2 * parts["cls"] + 3 * parts["centerness"] + 5 * parts["iou"]
    assert parts["total"].item() == pytest.approx(expected.item())


def test_losses_do_not_grow_with_the_batch():
    generator = torch.Generator().manual_seed(0)
    cls, centerness = (torch.randn(1, 17, 17, generator=generator) for _ in range(2))
    distances = torch.rand(1, 17, 17, 4, generator=generator) * 40
    one = losses((cls, centerness, distances), label(), LossWeights())
    three = losses(
        (cls.expand(3, -1, -1), centerness.expand(3, -1, -1), distances.expand(3, -1, -1, -1)),
        label(batch=3),
        LossWeights(),
    )
    for name in one:
        assert three[name].item() == pytest.approx(one[name].item(), rel=1e-5)


def _leaf(value: float, *shape: int) -> Tensor:
    return torch.full(shape, value, requires_grad=True)


@pytest.mark.parametrize("present", [True, False])
@pytest.mark.parametrize("value", [-1e4, -50.0, 0.0, 50.0, 1e4])
def test_losses_and_gradients_stay_finite(value: float, present: bool):
    cls, centerness, offsets = _leaf(value, 1, 17, 17), _leaf(value, 1, 17, 17), _leaf(value, 1, 17, 17, 4)
    distances = torch.exp(offsets.clamp(max=6)) * 8
    parts = losses((cls, centerness, distances), label(present), LossWeights())
    assert all(torch.isfinite(part) for part in parts.values())
    parts["total"].backward()
    for leaf in (cls, centerness, offsets):
        assert leaf.grad is not None
        assert torch.isfinite(leaf.grad).all()


def test_without_a_positive_cell_only_the_class_costs():
    maps = (torch.zeros(1, 17, 17), torch.zeros(1, 17, 17), torch.ones(1, 17, 17, 4))
    parts = losses(maps, label(present=False), LossWeights())
    assert parts["centerness"] == parts["iou"] == 0
    assert parts["cls"].item() == pytest.approx(289 * 0.75 * 0.25 * math.log(2), rel=1e-5)

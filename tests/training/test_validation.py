from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor, nn

from psiamfcpp.datasets import Sequence
from psiamfcpp.models import SiamFCpp
from psiamfcpp.models.network import cell_grid
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.spec import ModelSpec
from psiamfcpp.training.batches import Batch
from psiamfcpp.training.options import PairOptions
from psiamfcpp.training.validation import held_out_batches, pair_score


class Stub(nn.Module):
    """Says the given box with the given score at the cell nearest to that box, and nonsense elsewhere."""

    def __init__(self, corners: list[tuple[float, ...]], scores: list[float]):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))
        self._said = list(zip(corners, scores, strict=True))
        self.modes: list[bool] = []

    def template(self, z: Tensor) -> int:
        return len(z)

    def search(self, x: Tensor, kernels: int) -> tuple[Tensor, Tensor]:
        self.modes.append(self.training)
        assert len(x) == kernels
        grid = cell_grid(239, 9)
        scores, boxes = torch.full((kernels, 9, 9), 0.01), torch.zeros(kernels, 9, 9, 4)
        for i in range(kernels):
            corners, score = self._said.pop(0)
            box = torch.tensor(corners)
            cell = (grid - (box[:2] + box[2:]) / 2).norm(dim=-1).argmin()
            scores[i].view(-1)[cell] = score
            boxes[i].view(-1, 4)[cell] = box
        return scores, boxes


def batch(corners: list[tuple[float, ...]], present: list[bool] | None = None) -> Batch:
    n = len(corners)
    return Batch(
        torch.zeros(n, 127, 127, 3, dtype=torch.uint8),
        torch.zeros(n, 239, 239, 3, dtype=torch.uint8),
        torch.tensor(corners),
        torch.tensor(present or [True] * n),
        torch.full((n,), 40.0),
    )


TRUTH = [(100.0, 90.0, 139.0, 129.0), (110.0, 120.0, 129.0, 159.0)]


def shifted(dx: float, dy: float) -> list[tuple[float, ...]]:
    return [(x0 + dx, y0 + dy, x1 + dx, y1 + dy) for x0, y0, x1, y1 in TRUTH]


@pytest.mark.parametrize(
    ("dx", "dy", "within8", "within16"),
    [(0, 0, 1, 1), (8, 0, 1, 1), (0, -9, 0, 1), (6, 6, 0, 1), (-16, 0, 0, 1), (12, 12, 0, 0), (17, 0, 0, 0)],
)
def test_centre_errors_are_counted(dx: float, dy: float, within8: float, within16: float):
    score = pair_score(Stub(shifted(dx, dy), [0.9, 0.7]), [batch(TRUTH)])
    assert (score.within8, score.within16) == (within8, within16)
    assert score.score == pytest.approx(0.8)


def test_overlap_is_the_mean():
    # One box of 40 x 40 is met, one of 20 x 40 is moved by half its width: 10 of 30 columns are common.
    said = [TRUTH[0], (120.0, 120.0, 139.0, 159.0)]
    score = pair_score(Stub(said, [0.9, 0.9]), [batch(TRUTH)])
    assert score.overlap == pytest.approx((1 + 1 / 3) / 2)
    assert score.within8 == 0.5


def test_batches_are_joined():
    apart = pair_score(Stub([*TRUTH, *shifted(20, 0)], [0.9, 0.8, 0.7, 0.6]), [batch(TRUTH), batch(TRUTH)])
    assert apart.within8 == 0.5
    assert apart.score == pytest.approx(0.75)


@pytest.mark.parametrize(
    ("absent", "separation"), [([0.1, 0.2], 1.0), ([0.7, 0.1], 0.75), ([0.7, 0.8], 0.5), ([0.95, 0.99], 0.0)]
)
def test_separation_compares_every_true_pair_with_every_negative_one(absent: list[float], separation: float):
    # True pairs score 0.9 and 0.6.
    seen = batch([*TRUTH, *TRUTH], [True, True, False, False])
    score = pair_score(Stub([*TRUTH, *shifted(30, 0)], [0.9, 0.6, *absent]), [seen])
    assert score.separation == separation
    assert score.within8 == 1, "negative pairs have no place to be found at"


def test_a_target_outside_the_crop_counts_as_absent():
    seen = batch([*TRUTH, (300.0, 10.0, 340.0, 50.0)])
    score = pair_score(Stub([*TRUTH, TRUTH[0]], [0.9, 0.6, 0.7]), [seen])
    assert (score.within8, score.separation) == (1.0, 0.5)


def test_separation_needs_negative_pairs():
    assert pair_score(Stub(TRUTH, [0.9, 0.9]), [batch(TRUTH)]).separation is None


def test_every_module_gets_its_own_mode_back():
    """While training, the backbone's BatchNorm must keep its statistics, validation or not."""
    network = SiamFCpp(ModelSpec(widths=dict.fromkeys(ARCHITECTURE.groups, 3), search_size=239)).train()
    network.backbone.eval()
    before = {name: module.training for name, module in network.named_modules()}
    statistics = {name: value.clone() for name, value in network.named_buffers()}
    pair_score(network, [batch(TRUTH)])
    assert {name: module.training for name, module in network.named_modules()} == before
    assert all(torch.equal(statistics[name], value) for name, value in network.named_buffers())


def test_networks_are_evaluated_in_evaluation_mode():
    stub = Stub(TRUTH, [0.9, 0.9]).train()
    pair_score(stub, [batch(TRUTH)])
    assert stub.modes == [False]
    assert stub.training


def test_held_out_pairs_are_fixed_and_plain(scenes: list[Sequence]):
    clips = [s for s in scenes if len(s) > 1]
    options = PairOptions(search_size=239, negatives=0.0, augmentation=1.0)
    first = held_out_batches(clips, options, 60, 25)
    again = held_out_batches(clips, dataclasses.replace(options, augmentation=0.5, negatives=0.9), 60, 25)
    assert [len(b.present) for b in first] == [25, 25, 10]
    for a, b in zip(first, again, strict=True):
        assert torch.equal(a.search, b.search)
        assert torch.equal(a.corners, b.corners)
    absent = 1 - torch.cat([b.present for b in first]).float().mean()
    assert absent.item() == pytest.approx(0.2, abs=0.12)

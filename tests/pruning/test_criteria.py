"""Other criteria: torch-pruning's scores on our groups."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from psiamfcpp.errors import UserError
from psiamfcpp.models import SiamFCpp
from psiamfcpp.pruning.criteria import CRITERIA, keep_best, scores
from psiamfcpp.pruning.groups import Group, siamfcpp_groups

from .conftest import WIDTHS


class Chain(nn.Module):
    """Two layers without biases; what the second does with each map of the first is set by hand."""

    def __init__(self, first: list[float], second: list[float]):
        super().__init__()
        self.a = nn.Conv2d(1, len(first), 1, bias=False)
        self.b = nn.Conv2d(len(first), 1, 1, bias=False)
        with torch.no_grad():
            self.a.weight.copy_(torch.tensor(first)[:, None, None, None])
            self.b.weight.copy_(torch.tensor(second)[None, :, None, None])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.b(self.a(x))


X, GROUPS = torch.ones(1, 1, 4, 4), {"a": Group(("a",), 3)}


def test_norm_prefers_large_weights_on_both_sides() -> None:
    worth = scores(Chain([1, 2, -3], [1, 2, -3]), X, GROUPS, "norm")["a"]
    assert list(np.argsort(worth)) == [0, 1, 2]


def test_the_filter_nearest_to_all_others_is_worth_least_to_the_geometric_median() -> None:
    worth = scores(Chain([0, 1, 3], [1, 1, 1]), X, GROUPS, "median")["a"]
    assert worth.argmin() == 1


def test_taylor_prefers_what_the_loss_depends_on() -> None:
    network = Chain([1, 5, 2], [1, 0, 1])
    with pytest.raises(UserError, match="gradients"):
        scores(network, X, GROUPS, "taylor")
    network(X).sum().backward()
    worth = scores(network, X, GROUPS, "taylor")["a"]
    # Weight times gradient is 1*1 and 1*1, 5*0 and 0*5, 2*1 and 1*2.
    assert worth.argmin() == 1 and worth.argmax() == 2


def test_random_is_random_by_seed() -> None:
    network = Chain([1, 2, 3], [1, 1, 1])
    first, again, other = (scores(network, X, GROUPS, "random", seed)["a"] for seed in (0, 0, 1))
    assert (first == again).all() and (first != other).any()


@pytest.mark.parametrize("criterion", CRITERIA)
def test_every_criterion_scores_our_groups(
    siamese: SiamFCpp, pair: tuple[torch.Tensor, torch.Tensor], criterion: str
) -> None:
    if criterion == "taylor":
        sum(out.sum() for out in siamese(*pair)).backward()
    found = scores(siamese, pair, siamfcpp_groups(WIDTHS), criterion)
    assert {name: worth.shape for name, worth in found.items()} == {n: (w,) for n, w in WIDTHS.items()}
    assert all(np.isfinite(worth).all() and worth.std() > 0 for worth in found.values())


def test_unknown_criteria_are_refused() -> None:
    with pytest.raises(UserError, match="unknown criterion 'size'"):
        scores(Chain([1, 2, 3], [1, 1, 1]), X, GROUPS, "size")


def test_the_best_are_kept() -> None:
    assert keep_best({"a": np.array([3.0, 9, 9, 1])}, {"a": 2}).keep == {"a": [1, 2]}
    assert keep_best({"a": np.array([3.0, 9, 9, 1])}, {"a": 3}).keep == {"a": [0, 1, 2]}

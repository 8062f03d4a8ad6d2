"""The criterion refit: whose removal costs a least-squares fit least, by brute force and by known cases."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from psiamfcpp.errors import UserError
from psiamfcpp.pruning import CRITERIA, Context, find_groups, plan, plan_for_budget, score_table
from psiamfcpp.pruning.elimination import Fit, eliminate
from psiamfcpp.pruning.reading import RIDGE

from .conftest import randomize


def images(count: int = 4) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return [torch.rand(2, 3, 12, 12, generator=generator) for _ in range(count)]


def scored(network: nn.Module, name: str = "0") -> np.ndarray:
    """The criterion's scores of the group of a layer."""
    batches = images()
    groups = {name: find_groups(network, batches[0])[name]}
    context = Context(network, batches[0], batches=batches)
    table = score_table(groups, context, CRITERIA["refit"])
    assert table.groups[name].errors
    return table.groups[name].rank


def stack(width: int = 6, *behind: nn.Module) -> Any:
    return randomize(nn.Sequential(nn.Conv2d(3, width, 3), nn.ReLU(), *(behind or (nn.Conv2d(width, 4, 3),))))


def problem(seed: int, inputs: int = 8, outputs: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    """Second moments of correlated inputs, and weights."""
    generator = torch.Generator().manual_seed(seed)
    mixed = torch.randn(inputs, inputs, generator=generator, dtype=torch.float64)
    x = mixed @ torch.randn(inputs, 200, generator=generator, dtype=torch.float64)
    return x @ x.mT / 200, torch.randn(outputs, inputs, generator=generator, dtype=torch.float64)


def error_without(square: torch.Tensor, weight: torch.Tensor, gone: list[int]) -> float:
    """The least error of a fit without some inputs, solved anew: of the outputs, and of the weights' hold."""
    scale = square.diagonal().sqrt()
    held = square + RIDGE * torch.diag(scale**2)
    left = [i for i in range(len(square)) if i not in gone]
    best = torch.zeros_like(weight)
    best[:, left] = torch.linalg.solve(held[left][:, left], held[left] @ weight.mT).mT
    return float(torch.einsum("oi,ij,oj->", weight - best, held, weight - best))


@pytest.mark.parametrize("units", [[[i] for i in range(8)], [[0, 1], [2, 3], [4, 5], [6, 7]], [[0, 5], [], [1, 2, 3]]])
@pytest.mark.parametrize("seed", range(3))
def test_it_is_greedy_by_brute_force(seed: int, units: list[list[int]]) -> None:
    square, weight = problem(seed)
    found = eliminate([Fit.of(square, weight, [torch.tensor(unit).long() for unit in units])], len(units))
    gone: list[int] = []
    left = list(range(len(units)))
    while left:
        errors = {unit: error_without(square, weight, gone + units[unit]) for unit in left}
        cheapest = min(left, key=errors.__getitem__)
        assert float(found[cheapest]) == pytest.approx(errors[cheapest], rel=1e-6, abs=1e-9)
        gone += units[cheapest]
        left.remove(cheapest)


def test_the_errors_of_several_layers_add_up() -> None:
    units = [torch.tensor([i]) for i in range(8)]
    one, other = problem(1), problem(2)
    both = eliminate([Fit.of(*one, units), Fit.of(*other, units)], 8)
    first = int(both.argmin())
    alone = [error_without(*each, [first]) for each in (one, other)]
    assert float(both[first]) == pytest.approx(sum(alone), rel=1e-6)


def test_a_copy_goes_first_and_its_original_stays() -> None:
    network = stack()
    with torch.no_grad():
        network[0].weight[4], network[0].bias[4] = 2 * network[0].weight[1], 2 * network[0].bias[1]
    worth = scored(network)
    first = int(worth.argmin())
    assert first in (1, 4) and worth[first] < 0.05 * np.sort(worth)[1]
    # Alone, the other one is worth something.
    assert worth[5 - first] > 2 * np.sort(worth)[1]


def test_filters_that_are_constant_or_not_read_cost_nothing() -> None:
    network = stack()
    with torch.no_grad():
        network[0].weight[2], network[0].bias[2] = 0, 0.7
        network[2].weight[:, 3] = 0
    worth = scored(network)
    # The readers have a bias, which stands for a constant.
    assert worth[2] == 0 and worth[3] == pytest.approx(0, abs=1e-9)
    assert (np.delete(worth, [2, 3]) > 1e-4).all()
    network[2].bias = None
    assert scored(network)[2] > 1e-4


def test_neither_the_scale_of_filters_nor_that_of_their_readers_matters() -> None:
    network = stack()
    scaled = copy.deepcopy(network)
    factors = torch.tensor([0.01, 1.0, 30.0, 0.5, 7.0, 1000.0])
    with torch.no_grad():
        scaled[0].weight *= factors[:, None, None, None]
        scaled[0].bias *= factors
        scaled[2].weight *= 50 / factors[None, :, None, None]
    np.testing.assert_allclose(scored(scaled), scored(network), rtol=1e-3)


def test_an_error_is_a_share_of_the_readers_variance() -> None:
    worth = scored(stack())
    assert worth.max() == pytest.approx(1, abs=0.01)
    assert len(set(worth)) == 6


def test_depthwise_layers_are_followed_and_linear_layers_read() -> None:
    network = stack(6, nn.Conv2d(6, 6, 3, groups=6), nn.ReLU(), nn.Conv2d(6, 4, 1))
    assert len(scored(network)) == 6
    flat = stack(6, nn.Flatten(), nn.Linear(6 * 10 * 10, 5))
    with torch.no_grad():
        flat[3].weight[:, 200:300] = 0
    assert scored(flat).argmin() == 2


def test_grouped_convolutions_lose_the_same_positions(residual: nn.Module) -> None:
    batches = [torch.rand(2, 3, 24, 24) for _ in range(2)]
    groups = {n: g for n, g in find_groups(residual, batches[0]).items() if g.parts > 1}
    assert groups
    table = score_table(groups, Context(residual, batches[0], batches=batches), CRITERIA["refit"])
    for name, group in groups.items():
        parts = table.groups[name].rank.reshape(group.parts, -1)
        assert (parts == parts[0]).all() and len(set(parts[0])) == group.width // group.parts


def test_frozen_networks_are_seen_and_left_as_they_are(siamese: Any, pair: Any) -> None:
    from psiamfcpp.pruning.models import groups_of

    groups = {"backbone.conv2": groups_of(siamese.spec)["backbone.conv2"]}
    found = []
    for free in (True, False):
        siamese.train(free).requires_grad_(free)
        table = score_table(groups, Context(siamese, pair, batches=[pair]), CRITERIA["refit"])
        found.append(table.groups["backbone.conv2"].rank)
        assert siamese.training == free and {p.requires_grad for p in siamese.parameters()} == {free}
    np.testing.assert_allclose(*found)


def test_what_cannot_be_fitted_is_named() -> None:
    network = stack(6, nn.ConvTranspose2d(6, 4, 3))
    with pytest.raises(UserError, match="2 is a ConvTranspose2d, which cannot be fitted"):
        scored(network)
    with pytest.raises(UserError, match="looks at maps"):
        score_table(find_groups(stack(), images()[0]), Context(stack(), images()[0]), CRITERIA["refit"])


def test_plans_and_budgets_go_by_the_errors(tmp_path: Any) -> None:
    from psiamfcpp.pruning import RankTable
    from psiamfcpp.pruning.table import GroupRanks

    table = RankTable(
        1,
        {
            "cheap": GroupRanks(np.array([0.01, 0.9, 0.02, 0.03]), errors=True),
            "dear": GroupRanks(np.array([0.2, 0.1, 0.9, 0.5]), errors=True),
        },
    )
    table.write(tmp_path / "t.json")
    read = RankTable.read(tmp_path / "t.json")
    assert all(group.errors and not group.flat for group in read.groups.values())
    assert plan(read, keep={"dear": 0.5}).keep["dear"] == [2, 3]

    def cost(widths: Any) -> float:
        return float(sum(widths.values()))

    assert plan_for_budget(read, cost, 5).keep == {"cheap": [1], "dear": [0, 1, 2, 3]}
    assert plan_for_budget(read, cost, 4).keep == {"cheap": [1], "dear": [0, 2, 3]}
    assert plan_for_budget(read, cost, 5, multiple=2).keep == {"cheap": [1, 3], "dear": [2, 3]}
    with pytest.raises(UserError, match="cannot be met"):
        plan_for_budget(read, cost, 3, multiple=2)

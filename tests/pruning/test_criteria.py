"""Criteria: functions of a group and its context."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from psiamfcpp.errors import UserError
from psiamfcpp.models import SiamFCpp
from psiamfcpp.pruning import CRITERIA, Context, Group, find_criterion, gradients_of, plan, rank, score_table, scores
from psiamfcpp.pruning.models import groups_of
from psiamfcpp.spec import ModelSpec

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


def score(network: nn.Module, criterion: str, **context: Any) -> np.ndarray:
    return scores(GROUPS, Context(network, X, **context), find_criterion(criterion))["a"]


def test_norm_prefers_large_weights_on_both_sides() -> None:
    assert list(np.argsort(score(Chain([1, 2, -3], [1, 2, -3]), "norm"))) == [0, 1, 2]


def test_the_filter_nearest_to_all_others_is_worth_least_to_the_geometric_median() -> None:
    assert score(Chain([0, 1, 3], [1, 1, 1]), "median").argmin() == 1


def test_taylor_prefers_what_the_loss_depends_on() -> None:
    network = Chain([1, 5, 2], [1, 0, 1])
    with pytest.raises(UserError, match="gradients"):
        score(network, "taylor", gradients=gradients_of(network))
    network(X).sum().backward()
    gradients = gradients_of(network)
    network.zero_grad()
    worth = score(network, "taylor", gradients=gradients)
    # Weight times gradient is 1*1 and 1*1, 5*0 and 0*5, 2*1 and 1*2.
    assert worth.argmin() == 1 and worth.argmax() == 2
    # Gradients are lent to the network for the measure alone.
    assert all(p.grad is None for p in network.parameters())


def test_rank_reads_the_table_and_says_where_it_lacks_a_group() -> None:
    network = Chain([1, 2, 3], [1, 1, 1])
    table = rank(network, [X])
    assert (score(network, "rank", ranks=table) == table.groups["a"].rank).all()
    for ranks in (None, rank(network, [X], {"b": Group(("b",), 1, name="b")})):
        with pytest.raises(UserError, match="needs the rank table of a"):
            score(network, "rank", ranks=ranks)


def test_random_is_random_by_seed() -> None:
    network = Chain([1, 2, 3], [1, 1, 1])
    first, again = (score(network, "random") for _ in range(2))
    other = score(network, "random", generator=torch.Generator().manual_seed(1))
    assert (first == again).all() and (first != other).any()


@pytest.mark.slow
@pytest.mark.parametrize("criterion", CRITERIA)
def test_every_criterion_scores_our_groups(
    siamese: SiamFCpp, pair: tuple[torch.Tensor, torch.Tensor], criterion: str
) -> None:
    groups = groups_of(ModelSpec(widths=dict(WIDTHS)))
    sum(out.sum() for out in siamese(*pair)).backward()
    context = Context(siamese, pair, rank(siamese, [pair], groups), gradients_of(siamese), [pair])
    found = scores(groups, context, CRITERIA[criterion])
    assert {name: worth.shape for name, worth in found.items()} == {n: (w,) for n, w in WIDTHS.items()}
    # Random weights leave many maps their full rank, which orders nothing.
    assert sum(worth.std() > 0 for worth in found.values()) >= (5 if criterion == "rank" else len(WIDTHS))


def test_a_criterion_of_the_users_own_is_imported_and_plans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_criteria.py").write_text(
        "def middle(group, context):\n    return [1.0 if i == 1 else 0.5 + i / 10 for i in range(group.width)]\n"
    )
    monkeypatch.chdir(tmp_path)
    table = score_table(GROUPS, Context(Chain([1, 2, 3], [1, 1, 1]), X), find_criterion("my_criteria:middle"))
    assert plan(table, keep={"a": 1 / 3}).keep == {"a": [1]}
    assert plan(table, keep={"a": 2 / 3}).keep == {"a": [1, 2]}
    for name in ("my_criteria:absent", "no_such_module:f"):
        with pytest.raises(UserError, match=f"criterion '{name}' cannot be imported"):
            find_criterion(name)


def test_unknown_criteria_are_refused() -> None:
    with pytest.raises(UserError, match="unknown criterion 'size': known are rank, norm, median, taylor, random"):
        find_criterion("size")


@pytest.mark.parametrize("given", [[1.0, 2.0], [1.0, 2.0, float("nan")], [1.0, 2.0, -1.0], [[1.0, 2.0, 3.0]]])
def test_scores_that_are_no_scores_are_refused(given: list[float]) -> None:
    with pytest.raises(UserError, match="3 finite numbers from 0 up"):
        scores(GROUPS, Context(Chain([1, 2, 3], [1, 1, 1]), X), lambda group, context: np.array(given))


@pytest.mark.parametrize(
    "broken", [lambda: None, lambda group, context: context.nothing, "no function", lambda g, c: "x"]
)
def test_a_criterion_that_fails_is_one_line(broken: Any) -> None:
    with pytest.raises(UserError, match=r"the criterion failed on a \(\w+Error: .*fix the function") as refused:
        scores(GROUPS, Context(Chain([1, 2, 3], [1, 1, 1]), X), broken)
    assert "\n" not in str(refused.value)

"""Groups and pruning of networks with depthwise layers, gates and residual sums, from their tables."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from models.deployed import random_lightfc
from psiamfcpp.models.arch import ARCHITECTURES, OPERATIONS, architecture
from psiamfcpp.models.lightfc import LightFC
from psiamfcpp.pruning import Context, Plan, find_groups, rank, refit, score_table
from psiamfcpp.pruning.criteria import CRITERIA
from psiamfcpp.pruning.models import example_inputs, groups_of, prune_model


@pytest.fixture(scope="module")
def lightfc() -> LightFC:
    return random_lightfc()


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_groups_are_read_by_convolutions_and_reach_no_output(name: str) -> None:
    arch = architecture(name)
    outputs = {layer.name for layer in arch.outputs}
    for group in arch.groups:
        ties = arch.ties(group)
        assert ties.maps and ties.readers and outputs.isdisjoint((*ties.maps, *ties.others))
        for layer in (*ties.maps, *ties.others, *ties.readers):
            assert OPERATIONS[arch[layer].operation].weighted, layer


@pytest.mark.parametrize(
    ("group", "maps", "others", "readers"),
    [
        ("backbone.stem", ["backbone.depthwise0"], ["backbone.stem"], ["backbone.project0"]),
        ("backbone.expand6", ["backbone.depthwise6"], ["backbone.expand6"], ["backbone.project6"]),
        ("head.size1", ["head.size1"], ["head.size1_excite"], ["head.size1_squeeze", "head.size2"]),
        ("head.score4", ["head.score4"], [], ["head.score"]),
    ],
)
def test_ties_of_lightfc(group: str, maps: list[str], others: list[str], readers: list[str]) -> None:
    ties = architecture("lightfc").ties(group)
    assert [list(names) for names in (ties.maps, ties.others, ties.readers)] == [maps, others, readers]


def test_a_group_says_what_goes_with_its_filters(lightfc: LightFC) -> None:
    said = str(groups_of(lightfc.spec)["backbone.expand1"])
    assert "96 filters; tied in backbone.expand1, backbone.depthwise1; read by backbone.project1" in said


def some(lightfc: LightFC, every: int = 3) -> Plan:
    """A plan that removes one filter in so many of every group."""
    return Plan(
        {name: [i for i in range(width) if i % every] for name, width in lightfc.spec.widths.items()}  # type: ignore[attr-defined]
    )


@pytest.mark.slow
def test_torch_pruning_ties_the_same_layers(lightfc: LightFC) -> None:
    found = find_groups(lightfc, example_inputs(lightfc.spec))
    ours = {frozenset((*g.blocks, *g.others)) for g in groups_of(lightfc.spec).values()}
    theirs = {frozenset(block.removesuffix(".conv") for block in g.blocks) for g in found.values()}
    assert ours <= theirs


@pytest.mark.slow
def test_a_pruned_lightfc_is_the_original_with_silenced_maps(lightfc: LightFC) -> None:
    plan = some(lightfc)
    pruned = prune_model(lightfc, plan)
    assert pruned.spec.widths == plan.widths
    z, x = (crop.round() for crop in example_inputs(lightfc.spec))
    hooks = []
    for name, group in groups_of(lightfc.spec).items():
        keep = torch.zeros(group.width)
        keep[list(plan.keep[name])] = 1
        for block in group.blocks:
            silence: Callable[..., torch.Tensor] = lambda _m, _i, out, keep=keep: out * keep[:, None, None]  # noqa: E731
            hooks.append(lightfc.get_submodule(block).register_forward_hook(silence))
    try:
        with torch.no_grad():
            wanted, found = lightfc(z, x), pruned(z, x)
    finally:
        for hook in hooks:
            hook.remove()
    for a, b in zip(found, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4 * float(b.abs().max()))


@pytest.mark.slow
def test_rank_refit_and_fit_know_it(lightfc: LightFC) -> None:
    names = ("backbone.expand6", "head.size1")
    groups = {name: groups_of(lightfc.spec)[name] for name in names}
    batches = [example_inputs(lightfc.spec)]
    table = rank(lightfc, batches, groups)
    assert list(table.groups["backbone.expand6"].views) == ["template", "search"]
    assert table.groups["backbone.expand6"].max == (8 + 16) / 2
    scores = score_table(groups, Context(lightfc, batches[0], batches=batches), CRITERIA["refit"])
    assert {name: len(set(group.rank)) > 100 for name, group in scores.groups.items()} == dict.fromkeys(names, True)
    plan = Plan({name: sorted(map(int, group.rank.argsort()[64:])) for name, group in scores.groups.items()})
    pruned = prune_model(lightfc, plan)
    fitted = refit(pruned, lightfc, plan, batches, groups_of(lightfc.spec))
    with torch.no_grad():
        wanted, cut, better = (network(*batches[0])[1] for network in (lightfc, pruned, fitted))
    assert (better - wanted).abs().mean() < 0.5 * (cut - wanted).abs().mean()

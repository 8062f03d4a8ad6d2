"""Fitted weights make up for what was cut."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from psiamfcpp.errors import UserError
from psiamfcpp.models import SiamFCpp
from psiamfcpp.pruning import Plan, prune, refit
from psiamfcpp.pruning.groups import find_groups
from psiamfcpp.pruning.models import groups_of, prune_model
from psiamfcpp.spec import ModelSpec

from .conftest import WIDTHS, randomize

Pair = tuple[torch.Tensor, torch.Tensor]


def images(seed: int, count: int = 8) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.rand(4, 3, 24, 24, generator=generator) for _ in range(count)]


def apart(a: nn.Module, b: nn.Module, *inputs: torch.Tensor) -> float:
    """Largest difference of the outputs."""
    with torch.no_grad():
        one, other = a(*inputs), b(*inputs)
    pairs = zip(one, other, strict=True) if isinstance(one, tuple) else [(one, other)]
    return max(float((x - y).abs().max()) for x, y in pairs)


def stack(**first: object) -> nn.Sequential:
    """Two convolutions with BatchNorm and ReLU between."""
    layers = nn.Conv2d(3, 8, 3, **first), nn.BatchNorm2d(8), nn.ReLU(), nn.Conv2d(8, 5, 3, padding=1)  # type: ignore[arg-type]
    return randomize(nn.Sequential(*layers))  # type: ignore[return-value]


@pytest.mark.parametrize(
    "first", [{}, {"padding": "same"}, {"padding": 2, "padding_mode": "reflect"}, {"stride": 2, "bias": False}]
)
def test_what_a_copy_did_its_original_takes_over(first: dict[str, object]) -> None:
    network = stack(**first)
    conv, norm = network[0], network[1]
    with torch.no_grad():
        # filter 6 is 1.5 times filter 2 throughout
        for values in (norm.running_mean, norm.running_var, norm.weight, norm.bias, conv.weight, conv.bias):
            if values is not None:
                values[6] = values[2]
        norm.weight[6] *= 1.5
        norm.bias[6] *= 1.5
    plan = Plan({"0": [0, 1, 2, 3, 4, 5, 7]})
    pruned = prune(network, images(0)[0], plan)
    fitted = refit(pruned, network, plan, images(1))
    (unseen,) = images(2, 1)
    # what is left is the hold that the weights at hand have on the fit
    assert apart(pruned, network, unseen) > 0.1
    assert apart(fitted, network, unseen) < 0.15 * apart(pruned, network, unseen)


def test_keeping_everything_changes_no_bit(residual: nn.Module) -> None:
    whole = Plan({n: list(range(g.width)) for n, g in find_groups(residual, images(0)[0]).items()})
    fitted = refit(prune(residual, images(0)[0], whole), residual, whole, images(1, 2))
    assert all(torch.equal(value, residual.state_dict()[key]) for key, value in fitted.state_dict().items())


@pytest.mark.slow
def test_residual_and_grouped_networks_come_nearer_to_what_they_were(residual: nn.Module) -> None:
    groups = find_groups(residual, images(0)[0])
    half = Plan(
        {
            n: [f for f in range(g.width) if f % (g.width // g.parts) < g.width // g.parts // 2]
            for n, g in groups.items()
        }
    )
    pruned = prune(residual, images(0)[0], half)
    before = copy.deepcopy(pruned.state_dict())
    fitted = refit(pruned, residual, half, images(1))
    (unseen,) = images(2, 1)
    assert apart(fitted, residual, unseen) < 0.6 * apart(pruned, residual, unseen)
    assert fitted is not pruned and all(torch.equal(v, before[k]) for k, v in pruned.state_dict().items())


@pytest.mark.slow
@pytest.mark.parametrize("frozen", [False, True])
def test_our_network_comes_nearer_to_what_it_was(siamese: SiamFCpp, pair: Pair, frozen: bool) -> None:
    groups = groups_of(ModelSpec(widths=dict(WIDTHS)))
    plan = Plan({n: list(range(WIDTHS[n] - 1)) for n in ("backbone.conv2", "backbone.conv4", "head.cls2", "head.reg1")})
    pruned = prune_model(siamese, plan)
    for network in (siamese, pruned):
        # frozen, its blocks fold BatchNorm away
        network.requires_grad_(not frozen)
    fitted = refit(pruned, siamese, plan, [pair], groups)
    assert apart(fitted, siamese, *pair) < 0.5 * apart(pruned, siamese, *pair)
    assert fitted.spec == pruned.spec
    assert torch.equal(fitted.backbone.conv1.conv.weight, siamese.backbone.conv1.conv.weight)
    assert {p.requires_grad for p in fitted.parameters()} == {not frozen}


@pytest.mark.parametrize("bias", [True, False])
def test_a_layer_whose_inputs_are_all_zero_keeps_its_weights(bias: bool) -> None:
    network = stack()
    with torch.no_grad():
        # the three filters that are kept are dead, the others are not
        network[1].weight[:3], network[1].bias[:3] = 0, -1
    if not bias:
        network[3].bias = None
    plan = Plan({"0": [0, 1, 2]})
    pruned = prune(network, images(0)[0], plan)
    fitted = refit(pruned, network, plan, images(1, 1))
    assert torch.equal(fitted[3].weight, pruned[3].weight)
    if bias:
        assert apart(fitted, network, images(1, 1)[0]) < apart(pruned, network, images(1, 1)[0])


def test_watching_and_wrong_inputs(residual: nn.Module) -> None:
    plan = Plan({"blocks.0.conv1": [0, 6, 12, 18]})
    pruned = prune(residual, images(0)[0], plan)
    seen: list[str] = []
    refit(pruned, residual, plan, images(1, 1), watch=lambda names: seen.extend(names) or names)
    assert seen == [n for n, m in residual.named_modules() if isinstance(m, (nn.Conv2d, nn.Linear))]
    with pytest.raises(UserError, match="at least one batch"):
        refit(pruned, residual, plan, [])
    with pytest.raises(UserError, match="not what the plan makes"):
        refit(residual, residual, plan, images(1, 1))

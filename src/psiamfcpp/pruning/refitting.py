"""Weights fitted anew to the inputs that pruning has left, so that layers put out what they did before."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from psiamfcpp.errors import UserError
from psiamfcpp.pruning.groups import Group, find_groups
from psiamfcpp.pruning.planning import Plan
from psiamfcpp.pruning.reading import RIDGE, calls_of, layers_of, rows_of, run
from psiamfcpp.pruning.surgery import cut

Network = TypeVar("Network", bound=nn.Module)


class _PassedError(Exception):
    """A forward pass has come through the layer that is looked at: what follows is of no use."""


@torch.no_grad()
def refit(
    pruned: Network,
    original: nn.Module,
    plan: Plan,
    batches: list[Any],
    groups: Mapping[str, Group] | None = None,
    watch: Callable[[list[str]], Iterable[str]] = iter,
) -> Network:
    """A copy of a pruned network whose layers put out, as nearly as they can, what they did in the original.

    Layer by layer, in the order of a forward pass, weights and bias are fitted by least squares from the inputs that
    the layer has now to the outputs that the original's kept filters give, before BatchNorm (ridge regression towards
    the weights at hand). Later layers so make up for what earlier ones lost (He et al. 2017, Channel Pruning,
    section 3.1). No labels are needed. Convolutions (`nn.Conv2d`) and `nn.Linear` are fitted, others stay as they are.

    Args:
        pruned: what `prune` made of ``original`` by ``plan``.
        original: the network before.
        plan: the plan.
        batches: what the networks' forward takes, on their device: a hundred images or so, as in use.
        groups: as given to `prune`.
        watch: goes over the names of the layers while they are fitted, as progress bars do.

    Raises:
        UserError: no batch, or the pruned network is not what the plan makes of the original.
    """
    if not batches:
        raise UserError("there is no image to fit weights with: give at least one batch")
    # Blocks may fold a frozen BatchNorm into the convolution, whose own outputs would then not be seen.
    now, before = (copy.deepcopy(model).eval().requires_grad_(True) for model in (pruned, original))
    kept = _kept_filters(before, batches[0], plan, groups)
    if {name: len(layer.weight) for name, layer in layers_of(now)} != {name: len(kept[name]) for name in kept}:
        raise UserError("the pruned network is not what the plan makes of the original: their widths differ")
    calls = calls_of(now, batches[0])
    for name in watch(list(calls)):
        _fit(now, before, name, kept[name], batches, calls[name])
    result = copy.deepcopy(pruned)
    result.load_state_dict(now.state_dict())
    return result


def _kept_filters(
    original: nn.Module, example: Any, plan: Plan, groups: Mapping[str, Group] | None
) -> dict[str, Tensor]:
    """The numbers, in the original, of the filters that each layer keeps: pruned with it, as its weights."""
    marked = copy.deepcopy(original)
    for _, layer in layers_of(marked):
        layer.weight.transpose(0, -1).copy_(torch.arange(len(layer.weight)))
    # Without the check of `prune`: numbers instead of weights overflow.
    pruned, _ = cut(marked, example, plan, find_groups(marked, example) if groups is None else groups)
    return {name: layer.weight.flatten(1)[:, 0].long() for name, layer in layers_of(pruned)}


def _fit(now: nn.Module, before: nn.Module, name: str, kept: Tensor, batches: list[Any], calls: int) -> None:
    """Fit one layer, in place."""
    layer, taught = now.get_submodule(name), before.get_submodule(name)
    assert isinstance(layer, (nn.Conv2d, nn.Linear))
    groups = layer.groups if isinstance(layer, nn.Conv2d) else 1
    square, product = torch.zeros((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    for number, batch in enumerate(batches):
        seen, wanted = _passes(now, layer, batch, calls), _passes(before, taught, batch, calls)
        pairs = [(x, output, target[kept]) for (x, output), (_, target) in zip(seen, wanted, strict=True)]
        if number == 0 and all(torch.allclose(o, t, rtol=1e-4, atol=1e-4 * float(t.std())) for _, o, t in pairs):
            return  # nothing is lost so far: a layer before the first that was cut, or that one
        for x, output, target in pairs:
            rows = rows_of(layer, x)
            error = (target - output).reshape(groups, len(output) // groups, -1)
            square = square + (rows @ rows.mT).double()
            product = product + (rows @ error.mT).double()
    held = RIDGE * square.diagonal(dim1=1, dim2=2).mean().clamp(min=1e-12)
    square.diagonal(dim1=1, dim2=2).add_(held)
    change = torch.linalg.solve(square, product).mT.reshape(len(layer.weight), -1).to(layer.weight.dtype)
    if layer.bias is not None:
        layer.bias += change[:, -1]
        change = change[:, :-1]
    layer.weight += change.reshape(layer.weight.shape)


def _passes(model: nn.Module, layer: nn.Module, batch: Any, calls: int) -> list[tuple[Tensor, Tensor]]:
    """Inputs of a layer and its outputs, these with filters first, call by call."""
    found: list[tuple[Tensor, Tensor]] = []

    def seen(_module: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        # copies, since what comes next may write into them
        found.append((inputs[0].clone(), output.movedim(-1 if isinstance(layer, nn.Linear) else 1, 0).clone()))
        if len(found) == calls:
            raise _PassedError

    hook = layer.register_forward_hook(seen)
    try:
        run(model, batch)
    except _PassedError:
        pass
    finally:
        hook.remove()
    return found

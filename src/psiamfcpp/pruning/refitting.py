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
from psiamfcpp.pruning.reading import RIDGE, PassedError, calls_of, layers_of, rows_of, run
from psiamfcpp.pruning.surgery import cut

Network = TypeVar("Network", bound=nn.Module)


# Positions that a layer is fitted at, over all batches: ten times what the widest layers have of weights a filter.
_POSITIONS = 2**15


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
    limit = -(-_POSITIONS // len(batches))
    wanted = _targets(before, kept, batches, limit)
    for name in watch(list(calls)):
        _fit(now, name, wanted.pop(name), batches, calls[name], limit)
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


def _targets(before: nn.Module, kept: dict[str, Tensor], batches: list[Any], limit: int) -> dict[str, list[Tensor]]:
    """What each layer is to put out at the chosen positions, ``(filters, positions)`` for each batch and call."""
    found: dict[str, list[Tensor]] = {name: [] for name in kept}

    def seen(name: str, layer: nn.Module, output: Tensor) -> None:
        # a copy, since what comes next may write into it
        found[name].append(_chosen(_flat(layer, output), limit)[kept[name]].clone())

    hooks = [
        layer.register_forward_hook(lambda m, _inputs, output, name=name: seen(name, m, output))
        for name, layer in layers_of(before)
    ]
    try:
        for batch in batches:
            run(before, batch)
    finally:
        for hook in hooks:
            hook.remove()
    return found


def _flat(layer: nn.Module, output: Tensor) -> Tensor:
    """A layer's output as ``(filters, positions)``."""
    return output.movedim(-1 if isinstance(layer, nn.Linear) else 1, 0).flatten(1)


def _chosen(columns: Tensor, limit: int) -> Tensor:
    """Return at most N of the last axis, always the same of as many; neighbours say much the same."""
    count = columns.shape[-1]
    if count <= limit:
        return columns
    return columns[
        ..., torch.randperm(count, generator=torch.Generator().manual_seed(count))[:limit].to(columns.device)
    ]


def _fit(now: nn.Module, name: str, wanted: list[Tensor], batches: list[Any], calls: int, limit: int) -> None:
    """Fit one layer, in place."""
    layer = now.get_submodule(name)
    assert isinstance(layer, (nn.Conv2d, nn.Linear))
    groups = layer.groups if isinstance(layer, nn.Conv2d) else 1
    square, product = torch.zeros((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    for number, batch in enumerate(batches):
        targets = wanted[number * calls : (number + 1) * calls]
        pairs = [
            (_chosen(rows_of(layer, x), limit), _chosen(_flat(layer, output), limit), target)
            for (x, output), target in zip(_passes(now, layer, batch, calls), targets, strict=True)
        ]
        if number == 0 and all(torch.allclose(o, t, rtol=1e-4, atol=1e-4 * float(t.std())) for _, o, t in pairs):
            return  # nothing is lost so far: a layer before the first that was cut, or that one
        for rows, output, target in pairs:
            error = (target - output).reshape(groups, len(target) // groups, -1)
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
    """Inputs of a layer and its outputs, call by call."""
    found: list[tuple[Tensor, Tensor]] = []

    def seen(_module: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        # copies, since what comes next may write into them
        found.append((inputs[0].clone(), output.clone()))
        if len(found) == calls:
            raise PassedError

    hook = layer.register_forward_hook(seen)
    try:
        run(model, batch)
    except PassedError:
        pass
    finally:
        hook.remove()
    return found

"""Weights fitted anew to the inputs that pruning has left, so that layers put out what they did before."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from psiamfcpp.errors import UserError
from psiamfcpp.pruning.groups import Group
from psiamfcpp.pruning.planning import Plan
from psiamfcpp.pruning.surgery import prune

Network = TypeVar("Network", bound=nn.Module)

# Against the mean square of a layer's inputs: how strongly weights are held to what they were.
_RIDGE = 1e-3


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
    """A copy of a pruned network whose convolutions put out, as nearly as they can, what they did in the original.

    Layer by layer, in the order of a forward pass, weights and bias are fitted by least squares from the inputs that
    the layer has now to the outputs that the original's kept filters give, before BatchNorm (ridge regression towards
    the weights at hand). Later layers so make up for what earlier ones lost (He et al. 2017, Channel Pruning,
    section 3.1). No labels are needed. Convolutions are fitted, other layers stay as they are.

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
    widths = {name: m.out_channels for name, m in now.named_modules() if isinstance(m, nn.Conv2d)}
    if widths != {name: len(filters) for name, filters in kept.items()}:
        raise UserError("the pruned network is not what the plan makes of the original: their widths differ")
    calls = _calls(now, batches[0])
    for name in watch(list(calls)):
        _fit(now, before, name, kept[name], batches, calls[name])
    result = copy.deepcopy(pruned)
    result.load_state_dict(now.state_dict())
    return result


def _kept_filters(
    original: nn.Module, example: Any, plan: Plan, groups: Mapping[str, Group] | None
) -> dict[str, Tensor]:
    """The numbers, in the original, of the filters that each convolution keeps: pruned with it, as its weights."""
    marked = copy.deepcopy(original)
    for module in marked.modules():
        if isinstance(module, nn.Conv2d):
            module.weight.copy_(torch.arange(module.out_channels).view(-1, 1, 1, 1).expand_as(module.weight))
    marked = prune(marked, example, plan, groups)
    return {n: m.weight[:, 0, 0, 0].long() for n, m in marked.named_modules() if isinstance(m, nn.Conv2d)}


def _calls(model: nn.Module, example: Any) -> dict[str, int]:
    """How often a forward pass calls each convolution, in the order of the first calls."""
    calls: dict[str, int] = {}

    def called(name: str) -> None:
        calls[name] = calls.get(name, 0) + 1

    hooks = [
        module.register_forward_hook(lambda *_, name=name: called(name))
        for name, module in model.named_modules()
        if isinstance(module, nn.Conv2d)
    ]
    try:
        _run(model, example)
    finally:
        for hook in hooks:
            hook.remove()
    return calls


def _fit(now: nn.Module, before: nn.Module, name: str, kept: Tensor, batches: list[Any], calls: int) -> None:
    """Fit one layer, in place."""
    layer, taught = now.get_submodule(name), before.get_submodule(name)
    assert isinstance(layer, nn.Conv2d) and isinstance(taught, nn.Conv2d)
    square, product = torch.zeros((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    for batch in batches:
        targets = [output[:, kept] for _, output in _passes(before, taught, batch, calls)]
        for (x, output), target in zip(_passes(now, layer, batch, calls), targets, strict=True):
            if torch.allclose(output, target, rtol=1e-4, atol=1e-4 * float(target.std())):
                continue  # nothing is lost so far: as before the first layer that was cut
            rows = _rows(layer, x)
            error = (target - output).transpose(0, 1).reshape(layer.groups, layer.out_channels // layer.groups, -1)
            square = square + (rows @ rows.mT).double()
            product = product + (rows @ error.mT).double()
    if square.ndim == 0:
        return
    held = _RIDGE * square.diagonal(dim1=1, dim2=2).mean().clamp(min=1e-12)
    square.diagonal(dim1=1, dim2=2).add_(held)
    change = torch.linalg.solve(square, product).mT.reshape(layer.out_channels, -1).to(layer.weight.dtype)
    if layer.bias is not None:
        layer.bias += change[:, -1]
        change = change[:, :-1]
    layer.weight += change.reshape(layer.weight.shape)


def _rows(layer: nn.Conv2d, x: Tensor) -> Tensor:
    """What the weights of a filter are multiplied by: ``(groups, weights, positions)``, with ones for the bias."""
    mode = "constant" if layer.padding_mode == "zeros" else layer.padding_mode
    x = F.pad(x, layer._reversed_padding_repeated_twice, mode)
    seen = F.unfold(x, layer.kernel_size, layer.dilation, 0, layer.stride).transpose(0, 1)
    rows = seen.reshape(layer.groups, len(seen) // layer.groups, -1)
    return F.pad(rows, (0, 0, 0, 1), value=1.0) if layer.bias is not None else rows


def _passes(model: nn.Module, layer: nn.Module, batch: Any, calls: int) -> list[tuple[Tensor, Tensor]]:
    """Inputs and outputs of a layer, call by call."""
    found: list[tuple[Tensor, Tensor]] = []

    def seen(_module: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        # copies, since what comes next may write into them
        found.append((inputs[0].clone(), output.clone()))
        if len(found) == calls:
            raise _PassedError

    hook = layer.register_forward_hook(seen)
    try:
        _run(model, batch)
    except _PassedError:
        pass
    finally:
        hook.remove()
    return found


def _run(model: nn.Module, batch: Any) -> None:
    model(*batch) if isinstance(batch, (tuple, list)) else model(batch)

"""Cutting filters out of a network, with all that belongs to them."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from psiamfcpp.errors import UserError
from psiamfcpp.pruning.groups import Group, convolution_of, dependency_graph, find_groups
from psiamfcpp.pruning.planning import Plan

Network = TypeVar("Network", bound=nn.Module)

# Largest difference from the masked network, as a share of the largest output: far above float32's rounding.
_TOLERANCE = 1e-3


@dataclass
class Lost:
    """Channels, numbered as in the network before, that layers lose."""

    inputs: dict[str, set[int]] = field(default_factory=dict)
    """of layers that read removed filters"""
    normed: dict[str, set[int]] = field(default_factory=dict)
    """of layers whose statistics run over several channels"""


def prune(model: Network, example_inputs: Any, plan: Plan, groups: Mapping[str, Group] | None = None) -> Network:
    """Return a copy of a network with the filters that a plan keeps.

    Weights, biases, BatchNorm scales, shifts and running statistics of the kept filters are copied, the layers that
    read a removed filter lose its input, and layers that are tied (residual sums, correlation) lose the same filters.
    The copy is checked on the example inputs: its outputs must be those of the given network with the removed filters
    silenced, that is, with zero weights wherever they are read.

    Args:
        model: any network with convolutions; it is left as it is.
        example_inputs: what its forward takes, to trace the ties and for the check: a tensor, or a tuple of arguments.
        plan: the filters to keep; groups that it does not name stay whole.
        groups: the groups that the plan's names stand for; by default those of `find_groups`.

    Returns:
        The smaller network, in the mode of the given one.

    Raises:
        UserError: the plan is for another network, keeps different positions in the parts of a grouped convolution, or
            its cut changes what the kept filters do; or weights are masked or parametrized.
    """
    groups = find_groups(model, example_inputs) if groups is None else groups
    pruned, lost = cut(model, example_inputs, plan, groups)
    reason = _difference(model, pruned, lost, example_inputs)
    if reason:
        single = {name: Plan({name: filters}) for name, filters in plan.keep.items()}
        wrong = [
            n for n, p in single.items() if _difference(model, *cut(model, example_inputs, p, groups), example_inputs)
        ]
        raise UserError(
            f"without the removed filters of {', '.join(wrong or plan.keep)}, {reason}: something there orders or "
            "counts channels, as a channel shuffle does; keep these groups whole"
        )
    return pruned


def cut(model: Network, example_inputs: Any, plan: Plan, groups: Mapping[str, Group]) -> tuple[Network, Lost]:
    """Return what `prune` does before its check, and the channels that layers lose."""
    import torch_pruning

    _check_weights(model)
    pruned = copy.deepcopy(model)
    plan.check({name: group.width for name, group in groups.items()})
    graph = dependency_graph(pruned, example_inputs)
    names = {module: name for name, module in pruned.named_modules()}
    roots, lost = [], Lost()
    for name, filters in plan.keep.items():
        _check_parts(groups[name], filters)
        removed = sorted(set(range(groups[name].width)) - set(filters))
        if removed:
            root = convolution_of(pruned, groups[name].blocks[0])
            roots.append((root, removed))
            for dependency, channels in graph.get_pruning_group(root, torch_pruning.prune_conv_out_channels, removed):
                module = dependency.target.module
                if isinstance(module, (nn.GroupNorm, nn.LayerNorm)):
                    lost.normed.setdefault(names[module], set()).update(channels)
                elif graph.is_in_channel_pruning_fn(dependency.handler) and module in names:
                    lost.inputs.setdefault(names[module], set()).update(channels)
    for root, removed in roots:
        graph.get_pruning_group(root, torch_pruning.prune_conv_out_channels, removed).prune()
    return pruned, lost


@torch.no_grad()
def _difference(model: nn.Module, pruned: nn.Module, lost: Lost, example_inputs: Any) -> str | None:
    """What is wrong with a pruned network, against the one before with the removed filters silenced, or None."""
    masked, small = copy.deepcopy(model).eval(), copy.deepcopy(pruned).eval()
    for name, channels in lost.inputs.items():
        _silence(masked.get_submodule(name), sorted(channels))
    for name, channels in lost.normed.items():
        _norm_the_kept(masked.get_submodule(name), small.get_submodule(name), channels)
    wanted = _outputs(masked, example_inputs)
    try:
        found = _outputs(small, example_inputs)
    except Exception as error:  # a foreign network can fail in any way
        return f"the network does not run ({(str(error) or type(error).__name__).splitlines()[0]})"
    if [x.shape for x in wanted] != [x.shape for x in found]:
        return "the network's outputs have other shapes"
    if all(
        torch.allclose(x, y, rtol=0, atol=_TOLERANCE * float(y.abs().max())) for x, y in zip(found, wanted, strict=True)
    ):
        return None
    return "the outputs are not those of the network with these filters silenced"


def _outputs(model: nn.Module, inputs: Any) -> list[Tensor]:
    # a network may draw random numbers even in evaluation mode
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        if isinstance(inputs, dict):
            return list(_tensors(model(**inputs)))
        return list(_tensors(model(*inputs) if isinstance(inputs, (tuple, list)) else model(inputs)))


def _tensors(outputs: Any) -> Iterable[Tensor]:
    if isinstance(outputs, Tensor):
        return [outputs.double()]
    parts = outputs.values() if isinstance(outputs, Mapping) else outputs if isinstance(outputs, (tuple, list)) else ()
    return [tensor for part in parts for tensor in _tensors(part)]


def _silence(layer: nn.Module, channels: list[int]) -> None:
    """Set the weights of input channels to zero."""
    if isinstance(layer, nn.Linear):
        layer.weight[:, channels] = 0
    elif isinstance(layer, nn.modules.conv._ConvTransposeNd):
        layer.weight[channels] = 0
    elif isinstance(layer, nn.modules.conv._ConvNd):
        inputs, outputs = layer.in_channels // layer.groups, layer.out_channels // layer.groups
        for group, channel in (divmod(number, inputs) for number in channels):
            layer.weight[group * outputs : (group + 1) * outputs, channel] = 0


def _norm_the_kept(layer: nn.Module, small: nn.Module, removed: set[int]) -> None:
    """Have a layer take its statistics over the kept channels, as the smaller one does."""
    axis = 1 if isinstance(layer, nn.GroupNorm) else -1

    def normed(_layer: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> Tensor:
        kept = torch.tensor([c for c in range(output.shape[axis]) if c not in removed], device=output.device)
        return torch.zeros_like(output).index_copy(axis, kept, small(inputs[0].index_select(axis, kept)))

    layer.register_forward_hook(normed)


def _check_weights(model: nn.Module) -> None:
    for name, module in model.named_modules():
        for key in ("weight", "bias"):
            value = getattr(module, key, None)
            if isinstance(value, Tensor) and not isinstance(value, nn.Parameter):
                raise UserError(
                    f"the {key} of {name or 'the network'} is computed from other tensors (a mask of "
                    "torch.nn.utils.prune, weight_norm or a parametrization): make it permanent first, with "
                    "torch.nn.utils.prune.remove or torch.nn.utils.parametrize.remove_parametrizations"
                )


def _check_parts(group: Group, filters: list[int]) -> None:
    if group.parts == 1 or len(filters) == group.width:
        return
    size = group.width // group.parts
    if size == 1:
        raise UserError(
            f"{group.name} feeds a depthwise convolution with several outputs for each of its filters, which cannot be "
            "cut: keep all of it"
        )
    positions = [[f - k * size for f in filters if k * size <= f < (k + 1) * size] for k in range(group.parts)]
    if any(p != positions[0] for p in positions):
        raise UserError(
            f"{group.name} feeds a grouped convolution: keep the same positions in each of its {group.parts} blocks of "
            f"{size}"
        )

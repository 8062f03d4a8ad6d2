"""Cutting filters out of a network, with all that belongs to them."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

import torch
from torch import nn

from psiamfcpp.errors import UserError
from psiamfcpp.models.network import SiamFCpp
from psiamfcpp.pruning.groups import Group, convolution_of, dependency_graph, find_groups, siamfcpp_groups
from psiamfcpp.pruning.planning import Plan
from psiamfcpp.spec import TEMPLATE_SIZE

Network = TypeVar("Network", bound=nn.Module)


def prune(model: Network, example_inputs: Any, plan: Plan, groups: Mapping[str, Group] | None = None) -> Network:
    """A copy of a network with the filters that a plan keeps.

    Weights, biases, BatchNorm scales, shifts and running statistics of the kept filters are copied, the layers that
    read a removed filter lose its input, and layers that are tied (residual sums, correlation) lose the same filters.

    Args:
        model: any network with convolutions; it is left as it is.
        example_inputs: what its forward takes, to trace the ties: a tensor, or a tuple of arguments.
        plan: the filters to keep; groups that it does not name stay whole.
        groups: the groups that the plan's names stand for; by default those of `find_groups`.

    Returns:
        The smaller network, in the mode of the given one.

    Raises:
        UserError: the plan is for another network, or keeps different positions in the parts of a grouped convolution.
    """
    import torch_pruning

    pruned = copy.deepcopy(model)
    groups = find_groups(pruned, example_inputs) if groups is None else groups
    plan.check({name: group.width for name, group in groups.items()})
    graph = dependency_graph(pruned, example_inputs)
    for name, filters in plan.keep.items():
        group = groups[name]
        _check_parts(name, group, filters)
        removed = sorted(set(range(group.width)) - set(filters))
        if removed:
            root = convolution_of(pruned, group.blocks[0])
            graph.get_pruning_group(root, torch_pruning.prune_conv_out_channels, idxs=removed).prune()
    return pruned


def prune_siamfcpp(model: SiamFCpp, plan: Plan) -> SiamFCpp:
    """A copy of our network with the filters that a plan keeps; its spec has the new widths, and all else of the old.

    Raises:
        UserError: as of `prune`.
    """
    device = next(model.parameters()).device
    sizes = (TEMPLATE_SIZE, model.spec.search_size)
    example = tuple(torch.rand(1, 3, size, size, device=device) * 255 for size in sizes)
    cut = prune(model, example, plan, siamfcpp_groups(model.spec.widths))
    # Rebuilt from its widths, as loading will do, so that a network which does not fit them cannot come about.
    result = SiamFCpp(dataclasses.replace(model.spec, widths={**model.spec.widths, **plan.widths})).to(device)
    result.load_state_dict(cut.state_dict())
    return result.train(model.training)


def _check_parts(name: str, group: Group, filters: list[int]) -> None:
    if group.parts == 1:
        return
    size = group.width // group.parts
    positions = [[f - k * size for f in filters if k * size <= f < (k + 1) * size] for k in range(group.parts)]
    if any(p != positions[0] for p in positions):
        raise UserError(
            f"{name} feeds a grouped convolution: keep the same positions in each of its {group.parts} blocks of {size}"
        )

"""Other measures of a filter's worth, to compare rank with; torch-pruning computes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import nn

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import FloatArray
from psiamfcpp.pruning.groups import Group, convolution_of, dependency_graph
from psiamfcpp.pruning.planning import Plan

CRITERIA = ("norm", "median", "taylor", "random")


def scores(
    model: nn.Module, example_inputs: Any, groups: Mapping[str, Group], criterion: str, seed: int = 0
) -> dict[str, FloatArray]:
    """Worth ``(n,)`` of each group's filters over all layers that they belong to or feed.

    Args:
        model: the network; for ``taylor`` with gradients of the loss in all its weights.
        example_inputs: what its forward takes.
        groups: the groups to score.
        criterion: ``norm`` (L2 norm of the weights), ``median`` (distance from the geometric median, He et al. 2019),
            ``taylor`` (weights times gradients, Molchanov et al. 2019) or ``random``.
        seed: of ``random``.

    Raises:
        UserError: an unknown criterion, or ``taylor`` without gradients.
    """
    import torch_pruning
    from torch_pruning.pruner import importance

    measures: dict[str, Callable[[], Any]] = {
        "norm": importance.GroupMagnitudeImportance,
        "median": importance.FPGMImportance,
        "taylor": importance.GroupTaylorImportance,
        "random": importance.RandomImportance,
    }
    if criterion not in measures:
        raise UserError(f"unknown criterion {criterion!r}: known are rank, {', '.join(measures)}")
    if criterion == "taylor" and any(convolution_of(model, g.blocks[0]).weight.grad is None for g in groups.values()):
        raise UserError("the criterion taylor needs gradients: run a loss backward through the network first")
    graph, measure = dependency_graph(model, example_inputs), measures[criterion]()
    result = {}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for name, group in groups.items():
            root = convolution_of(model, group.blocks[0])
            every = list(range(group.width))
            tied = graph.get_pruning_group(root, torch_pruning.prune_conv_out_channels, idxs=every)
            result[name] = measure(tied).double().cpu().numpy()
    return result


def keep_best(worth: Mapping[str, FloatArray], counts: Mapping[str, int]) -> Plan:
    """The plan that keeps the filters of the greatest worth, so many of each group."""
    return Plan({n: [int(f) for f in np.argsort(-w, kind="stable")[: counts[n]]] for n, w in worth.items()})

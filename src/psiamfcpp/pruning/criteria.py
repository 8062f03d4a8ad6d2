"""Criteria: what each filter of a group is worth. A criterion is any function ``f(group, context) -> scores (n,)``."""

from __future__ import annotations

import copy
import functools
import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import FloatArray
from psiamfcpp.pruning.elimination import eliminate, fits_of
from psiamfcpp.pruning.groups import Group, convolution_of, dependency_graph
from psiamfcpp.pruning.ranking import weight_norm
from psiamfcpp.pruning.table import GroupRanks, RankTable


@dataclass(frozen=True)
class Context:
    """What a criterion may look at."""

    model: nn.Module
    """the network"""
    example_inputs: Any
    """what its forward takes: a tensor, or a tuple of arguments"""
    ranks: RankTable | None = None
    """the network's rank table, if it was ranked"""
    gradients: Mapping[str, Tensor] | None = None
    """gradient of a loss for each parameter by name, if a loss was run backward; see `gradients_of`"""
    batches: Sequence[Any] = ()
    """what its forward takes, as in use: a hundred images or so, for criteria that look at maps"""
    generator: torch.Generator = field(default_factory=lambda: torch.Generator().manual_seed(0))
    """of criteria that draw"""

    @functools.cached_property
    def dependencies(self) -> Any:
        """torch-pruning's dependency graph of the network."""
        return dependency_graph(self.model, self.example_inputs)


Criterion = Callable[[Group, Context], FloatArray]


def rank(group: Group, context: Context) -> FloatArray:
    """Return the average rank ``(n,)`` of each filter's map (paper, section 3.2)."""
    if context.ranks is None or group.name not in context.ranks.groups:
        fix = "give --ranks FILE, which `psiamfcpp rank` writes"
        raise UserError(f"the criterion rank needs the rank table of {group.name}: {fix}")
    return context.ranks.groups[group.name].rank


def norm(group: Group, context: Context) -> FloatArray:
    """Return the L2 norm ``(n,)`` of the weights of each filter and of what reads it."""
    return _importance("GroupMagnitudeImportance", group, context)


def median(group: Group, context: Context) -> FloatArray:
    """Return the distance ``(n,)`` of each filter from the geometric median (He et al. 2019, FPGM)."""
    return _importance("FPGMImportance", group, context)


def taylor(group: Group, context: Context) -> FloatArray:
    """Return weights times gradients ``(n,)`` of each filter and of what reads it (Molchanov et al. 2019)."""
    if context.gradients is None:
        raise UserError("the criterion taylor needs gradients: run a loss backward through the network first")
    parameters = dict(context.model.named_parameters())
    before = {name: parameter.grad for name, parameter in parameters.items()}
    try:
        for name, parameter in parameters.items():
            parameter.grad = context.gradients.get(name)
        return _importance("GroupTaylorImportance", group, context)
    finally:
        for name, parameter in parameters.items():
            parameter.grad = before[name]


def random(group: Group, context: Context) -> FloatArray:
    """Return numbers ``(n,)`` from 0 to 1, drawn anew at each call: the criterion that others must beat."""
    return torch.rand(group.width, generator=context.generator).double().numpy()


def refit(group: Group, context: Context) -> FloatArray:
    """Return the error ``(n,)`` that the layers which read a group reach when its filters are removed one by one.

    Always that filter goes next whose removal costs the least-squares fit of these layers least, so that a filter is
    worth what is lost with it and with all that are worth less. The error is the mean square of what a layer's outputs
    are off, over their variance: the sum over the layers, 0 where nothing is lost and about 1 a layer where nothing is
    left. It does not change with the scale of a filter, and compares from group to group.

    Filters that a grouped convolution ties are removed together.
    """
    if not context.batches:
        raise UserError("the criterion refit looks at maps: give --data LAYOUT:FOLDER (in Python, batches)")
    positions = group.width // group.parts
    # Blocks may fold a frozen BatchNorm into the convolution, whose own inputs would then not be seen.
    model = copy.deepcopy(context.model).eval().requires_grad_(True)
    fits = fits_of(model, _readers(group, context, positions), positions, context.batches)
    reached: FloatArray = eliminate(fits, positions).numpy()
    return np.tile(reached, group.parts)


CRITERIA: dict[str, Criterion] = {f.__name__: f for f in (rank, norm, median, taylor, random, refit)}
# Those that look at gradients, and so need a loss and data.
WITH_LOSS = frozenset({"taylor"})
# Those that look at maps, and so need data.
WITH_MAPS = frozenset({"refit"})
# Those whose scores are errors: reached with the filter gone and all that score less, and alike from group to group.
_ERRORS = frozenset({refit})


def find_criterion(name: str) -> Criterion:
    """Return the criterion of a name of `CRITERIA`, or ``MODULE:FUNCTION`` of the user's own.

    Raises:
        UserError: there is no such criterion, or the function cannot be imported.
    """
    if name in CRITERIA:
        return CRITERIA[name]
    module, colon, function = name.rpartition(":")
    if not colon:
        raise UserError(f"unknown criterion {name!r}: known are {', '.join(CRITERIA)}, and MODULE:FUNCTION")
    # Where the command was started, as `python -m` has it.
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        found: Criterion = getattr(importlib.import_module(module), function)
    except Exception as error:  # a foreign module can fail in any way
        raise UserError(
            f"criterion {name!r} cannot be imported ({type(error).__name__}: {error}): MODULE:FUNCTION is needed"
        ) from error
    return found


def gradients_of(model: nn.Module) -> dict[str, Tensor] | None:
    """Return the gradients that a network's parameters hold, by name; None where one of its weights has none."""
    found = {name: parameter.grad for name, parameter in model.named_parameters() if parameter.grad is not None}
    return None if any(p.ndim > 1 and n not in found for n, p in model.named_parameters()) else found


def scores(groups: Mapping[str, Group], context: Context, criterion: Criterion) -> dict[str, FloatArray]:
    """Return what a criterion gives for each group, by name.

    Raises:
        UserError: the criterion fails, or gives anything but one finite number from 0 up for each filter.
    """
    found = {}
    for name, group in groups.items():
        try:
            given = np.asarray(criterion(group, context), dtype=np.float64)
        except UserError:
            raise
        except Exception as error:  # a function of the user's can fail in any way
            said = f"the criterion failed on {name} ({type(error).__name__}: {error})"
            raise UserError(f"{said}: fix the function f(group, context) -> scores (n,)") from error
        if given.shape != (group.width,) or not np.isfinite(given).all() or (given < 0).any():
            raise UserError(
                f"the criterion gave {name} scores of shape {given.shape}: {group.width} finite numbers from 0 up are "
                "expected, the highest for the filters to keep"
            )
        found[name] = given
    return found


def score_table(groups: Mapping[str, Group], context: Context, criterion: Criterion) -> RankTable:
    """Return a criterion's scores as a table, which `psiamfcpp.pruning.plan` takes like one of ranks.

    Raises:
        UserError: as of `scores`.
    """
    worth = scores(groups, context, criterion)
    norms = {name: weight_norm(context.model, group) for name, group in groups.items()}
    rows = {
        name: GroupRanks(worth[name], None, norms[name], group.parts, errors=criterion in _ERRORS)
        for name, group in groups.items()
    }
    return RankTable(0 if context.ranks is None else context.ranks.images, rows)


def _importance(name: str, group: Group, context: Context) -> FloatArray:
    """What one of torch-pruning's measures gives for a group."""
    from torch_pruning.pruner import importance

    measure = getattr(importance, name)(normalizer=_over_mean)
    values: FloatArray = measure(_tied(group, context)).double().cpu().numpy()
    return values


def _over_mean(values: Tensor) -> Tensor:
    """Return values over their mean; zeros, as of a group that the loss does not depend on, stay zeros."""
    mean = values.mean()
    return values if mean == 0 else values / mean


def _readers(group: Group, context: Context, positions: int) -> dict[str, dict[int, int]]:
    """By name of a layer that reads a group: the position of the filter that each input comes from."""
    names = {module: name for name, module in context.model.named_modules()}
    found: dict[str, dict[int, int]] = {}
    graph = context.dependencies
    for item in _tied(group, context):
        layer, handler = item.dep.target.module, item.dep.handler
        # BatchNorm and depthwise convolutions lose inputs and outputs in one: they hand channels on.
        hands_on = graph.is_out_channel_pruning_fn(handler)
        if graph.is_in_channel_pruning_fn(handler) and not hands_on and layer in names:
            inputs = zip(item.idxs, item.root_idxs, strict=True)
            found.setdefault(names[layer], {}).update({channel: root % positions for channel, root in inputs})
    return found


def _tied(group: Group, context: Context) -> Any:
    """torch-pruning's record of all that loses channels with a group."""
    import torch_pruning

    root = convolution_of(context.model, group.blocks[0])
    return context.dependencies.get_pruning_group(
        root, torch_pruning.prune_conv_out_channels, idxs=list(range(group.width))
    )

"""Average ranks of feature maps (paper, section 3.2; Lin et al. 2020, HRank)."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import FloatArray
from psiamfcpp.pruning.groups import Group, convolution_of, find_groups
from psiamfcpp.pruning.table import GroupRanks, RankTable, View

# What a convolution's map goes through before it counts as the filter's, as `torch.nn.functional` or torch calls it.
_CALLED = """
batch_norm instance_norm _threshold celu celu_ clamp clamp_ elu elu_ gelu hardshrink hardsigmoid hardswish hardtanh
hardtanh_ leaky_relu leaky_relu_ log_sigmoid mish prelu relu relu6 relu_ rrelu rrelu_ selu selu_ sigmoid sigmoid_ silu
softplus softshrink softsign tanh tanh_ tanhshrink threshold
"""
_FOLLOWERS = frozenset(_CALLED.split())
TOLERANCE = "singular values above max(height, width) * 2**-23 * the map's largest, in float32"


@dataclass(frozen=True)
class Looked:
    """What one forward pass showed of a group: one entry a map, in the order in which the maps were made."""

    ranks: tuple[NDArray[np.int16], ...]
    """each ``(B, n)``"""
    sizes: tuple[int, ...]
    """highest rank that each map's size allows"""


def rank(model: nn.Module, batches: Iterable[Any], groups: Mapping[str, Group] | None = None) -> RankTable:
    """Average rank of each filter's map over images.

    A filter's map is the output of its convolution after the BatchNorm and activation that read it at once, be they
    modules or functions such as ``F.relu``. Ranks are counted as NumPy's ``matrix_rank`` counts them: see `TOLERANCE`.

    Args:
        model: any network with convolutions; it is put into evaluation mode for this and back.
        batches: what its forward takes: tensors ``(B, ...)``, or tuples of them.
        groups: the groups to rank; by default all that `find_groups` finds with the first batch.

    Returns:
        The table of all groups.

    Raises:
        UserError: there is no batch, no map, or a map holds values that are not finite.
    """
    if groups is None:
        batches = iter(batches)
        first = next(batches, None)
        if first is None:
            raise UserError("there is no image to rank with: give at least one batch")
        groups = find_groups(model, first)
        batches = (batch for part in ([first], batches) for batch in part)
    return table(model, groups, list(look(model, batches, groups)))


def table(model: nn.Module, groups: Mapping[str, Group], looks: list[dict[str, Looked]]) -> RankTable:
    """The means of what `look` saw.

    Raises:
        UserError: nothing was seen.
    """
    if not looks:
        raise UserError("there is no image to rank with: give at least one batch")
    rows, images = {}, 0
    for name, group in groups.items():
        per_map = [
            View(np.concatenate([seen[name].ranks[k] for seen in looks]).mean(axis=0), size)
            for k, size in enumerate(looks[0][name].sizes)
        ]
        images = sum(len(seen[name].ranks[0]) for seen in looks)
        rows[name] = GroupRanks(
            np.mean([view.rank for view in per_map], axis=0),
            float(np.mean([view.max for view in per_map])),
            weight_norm(model, group),
            group.parts,
            dict(zip(group.views, per_map, strict=True)) if group.views else {},
        )
    return RankTable(images, rows, {"tolerance": TOLERANCE})


@torch.no_grad()
def look(model: nn.Module, batches: Iterable[Any], groups: Mapping[str, Group]) -> Iterator[dict[str, Looked]]:
    """The ranks of every map, batch by batch.

    Args:
        model: the network, on any device.
        batches: what its forward takes, on the same device.
        groups: the groups to look at.

    Raises:
        UserError: a group has no map, or one holds values that are not finite.
    """
    # Mode by mode: while training, parts of a network may be in evaluation mode already.
    modes = {module: module.training for module in model.modules()}
    blocks = {block: name for name, group in groups.items() for block in group.blocks}
    try:
        for batch in batches:
            model.eval()
            with _watch(model, blocks) as maps:
                model(*batch) if isinstance(batch, (tuple, list)) else model(batch)
            yield {name: _looked(name, maps[name]) for name in groups}
    finally:
        for module, training in modes.items():
            module.training = training


def map_ranks(maps: Tensor) -> Tensor:
    """Rank of each map.

    Args:
        maps: ``(..., H, W)`` of any floating-point type; they are taken as float32.

    Returns:
        ``(...)`` whole numbers, 0 for a map of zeros.
    """
    return torch.linalg.matrix_rank(maps.float())


def weight_norm(model: nn.Module, group: Group) -> FloatArray:
    """L2 norm ``(n,)`` of each filter's weights over all tied convolutions."""
    tied = (*group.others, *group.blocks)
    weights = [convolution_of(model, block).weight.detach().flatten(1) for block in tied]
    return torch.cat(weights, dim=1).double().norm(dim=1).cpu().numpy()


def _looked(name: str, maps: list[Tensor]) -> Looked:
    if not maps:
        raise UserError(f"no forward pass came through {name}: leave it out, or give other inputs")
    if not all(torch.isfinite(m).all() for m in maps):
        raise UserError(f"maps of {name} hold values that are not finite: the weights or the images are damaged")
    ranks = tuple(map_ranks(m).cpu().numpy().astype(np.int16) for m in maps)
    return Looked(ranks, tuple(min(m.shape[-2:]) for m in maps))


class _Followers(TorchFunctionMode):
    """Keep, of each map, what the functions of `_FOLLOWERS` make of it, called by a module or by the network itself."""

    def __init__(self) -> None:
        super().__init__()
        # By identity of a map: the map with its version when made, the list of its group, and its place there.
        self.latest: dict[int, tuple[Tensor, int, list[Tensor], int]] = {}

    def keep(self, output: Tensor, held: list[Tensor], place: int) -> None:
        """Put a copy of a map into its place, because a network may write into its maps afterwards."""
        held[place:] = [output.detach().clone(), *held[place + 1 :]]
        self.latest[id(output)] = (output, output._version, held, place)

    def __torch_function__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        """Call a function of torch, and keep its output where it follows a map that is as it was made."""
        found = self.latest.get(id(args[0])) if args and getattr(func, "__name__", "") in _FOLLOWERS else None
        follows = found and found[0] is args[0] and found[1] == args[0]._version
        output = func(*args, **(kwargs or {}))
        if found and follows:
            self.keep(output, *found[2:])
        return output


@contextlib.contextmanager
def _watch(model: nn.Module, blocks: Mapping[str, str]) -> Iterator[dict[str, list[Tensor]]]:
    """Collect the maps of each group while the network runs, after the BatchNorm and activation that follow."""
    maps: dict[str, list[Tensor]] = {name: [] for name in blocks.values()}
    followers = _Followers()

    def block_done(name: str, output: Any) -> None:
        if not isinstance(output, Tensor) or output.ndim != 4:
            raise UserError(f"{name} does not give maps (batch, filters, height, width): leave it out")
        followers.keep(output, maps[name], len(maps[name]))

    hooks = []
    for block, name in blocks.items():
        convolution_of(model, block)
        module = model.get_submodule(block)
        hooks.append(module.register_forward_hook(lambda _m, _a, output, name=name: block_done(name, output)))
    try:
        with followers:
            yield maps
    finally:
        for hook in hooks:
            hook.remove()

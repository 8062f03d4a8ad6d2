"""Architectures as tables of layers, from which every size, cost, group and graph is derived; torch is not needed.

An architecture is one module with a table, named in `ARCHITECTURES`; a module of yours may add itself there
(docs/own-network.md). The table says which files build its network and its graphs; no other file names a layer.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import context_side

# What the first layer reads, in place of a layer's name.
PIXELS = "pixels"
# Architecture of files that name none, as those of version 0.1.
DEFAULT = "siamfcpp-alexnet"
# Name of each architecture, and the module whose ``ARCHITECTURE`` is its table.
ARCHITECTURES = {DEFAULT: "psiamfcpp.models.siamfcpp_alexnet", "lightfc": "psiamfcpp.models.lightfc_table"}

Output = TypeVar("Output")


@dataclass(frozen=True)
class Layer:
    """One row of the table: a convolution, or another operation of `OPERATIONS`."""

    name: str
    """``part.name``, as in the names of the weights"""
    reads: tuple[str, ...]
    """layers whose maps it reads, or `PIXELS`; a correlation reads features, then kernels"""
    width: int = 0
    """number of filters in the unpruned network; 0 where it follows from what is read"""
    kernel: int = 1
    """side of the kernel"""
    stride: int = 1
    bn: bool = True
    """whether BatchNorm follows"""
    padding: int = 0
    """rows and columns of zeros on each side"""
    relu: bool = True
    """whether ReLU follows"""
    activation: str | None = None
    """what follows in place of ReLU: relu6, gelu or sigmoid"""
    pool: tuple[int, int] | None = None
    """kernel and stride of the max-pool at the end, which rounds sizes up"""
    operation: str = "convolution"
    """a key of `OPERATIONS`"""
    group: str | None = None
    """prunable group, which ties layers channel by channel; None for a layer that keeps its width"""
    ablation: str | None = None
    """row of the ablation (paper, section 4.5) that prunes it alone, or with others of the same row"""
    thaw: float | None = None
    """share of a training run after which it is trained, 1 for never; None where it is trained throughout"""
    joined: str | None = None
    """name that it shares in exported graphs with layers that read the same input, since they are one layer there"""

    @property
    def part(self) -> str:
        """Part of the network that holds it."""
        return self.name.partition(".")[0]

    @property
    def child(self) -> str:
        """Name within its part."""
        return self.name.partition(".")[2]


@dataclass(frozen=True)
class Operation:
    """What the table needs to know of an operation; ``sides`` and ``widths`` are those of what a layer reads."""

    side: Callable[[Layer, list[int]], int]
    """side of the map that it gives, before the pool"""
    width: Callable[[int, list[int]], int]
    """number of channels, from the layer's own width"""
    macs: Callable[[Layer, list[int], list[int], int, int], int]
    """multiply-accumulates, from layer, sides, widths, own side and own width"""
    weighted: bool = False
    """a convolution, with weights of its own"""
    crossed: bool = False
    """a correlation, whose second input comes from the template crop"""
    carries: bool = True
    """whether it hands on the channels of what it reads, one by one or one behind the other"""
    factors: bool = False
    """whether its second input holds one factor for each channel, which is no map"""


def _side_of_convolution(layer: Layer, sides: list[int]) -> int:
    return (sides[0] + 2 * layer.padding - layer.kernel) // layer.stride + 1


def _without_weights(width: Callable[[int, list[int]], int], side: int | None = None) -> Operation:
    """Return an operation whose few operations are not counted; ``side`` where it is not that of the first input."""
    return Operation(lambda layer, sides: side or sides[0], width, lambda *_: 0)


OPERATIONS: dict[str, Operation] = {
    "convolution": Operation(
        side=_side_of_convolution,
        width=lambda own, widths: own,
        macs=lambda layer, sides, widths, side, width: layer.kernel**2 * widths[0] * width * side**2,
        weighted=True,
        carries=False,
    ),
    # A filter for each channel.
    "depthwise": Operation(
        side=_side_of_convolution,
        width=lambda own, widths: widths[0],
        macs=lambda layer, sides, widths, side, width: layer.kernel**2 * width * side**2,
        weighted=True,
    ),
    # Channel by channel, with the template's map as kernel.
    "correlation": Operation(
        side=lambda layer, sides: sides[0] - sides[1] + 1,
        width=lambda own, widths: widths[0],
        macs=lambda layer, sides, widths, side, width: width * sides[1] ** 2 * side**2,
        crossed=True,
    ),
    # Each cell of the search features with each cell of the template's; a channel for each cell of the template.
    "cells": Operation(
        side=lambda layer, sides: sides[0],
        width=lambda own, widths: own,
        macs=lambda layer, sides, widths, side, width: widths[0] * width * side**2,
        crossed=True,
        carries=False,
    ),
    "sum": _without_weights(lambda own, widths: widths[0]),
    "join": _without_weights(lambda own, widths: sum(widths)),
    "mean": _without_weights(lambda own, widths: widths[0], side=1),
    # A map times a factor for each channel.
    "gate": dataclasses.replace(_without_weights(lambda own, widths: widths[0]), factors=True),
}


@dataclass(frozen=True)
class Ties:
    """What loses channels with the filters of a group."""

    maps: tuple[str, ...]
    """layers whose maps the readers see, and which so speak for the filters"""
    others: tuple[str, ...]
    """further layers that lose the same filters: those before a depthwise one, and the factors of a gate"""
    readers: tuple[str, ...]
    """layers that lose inputs"""


@dataclass(frozen=True, eq=False)
class Architecture:
    """A network as data: its table, its sizes, and the files that build it."""

    layers: tuple[Layer, ...]
    """in the order in which the network makes its modules; what a layer reads stands before it"""
    network: str
    """``module:Class`` of the torch network; see `psiamfcpp.models.network.Network` for what it offers.

    It takes a `psiamfcpp.spec.ModelSpec`, keeps it as ``spec``, and names its modules as the table does; those of its
    part ``backbone`` are thawed one by one. `psiamfcpp.models.build` opens it."""
    exporter: str
    """module with ``layers(model)``, ``template_graph`` and ``search_graph``, see `psiamfcpp.export.graph`"""
    procedure: str
    """``module:NAME`` of how it is followed with, see `psiamfcpp.trackers.siamfcpp.procedure.Procedure`"""
    objective: str
    """``module:NAME`` of what it is trained to, see `psiamfcpp.training.objective.Objective`"""
    template_size: int
    """side of the template crop, pixels"""
    search_size: int
    """side of the search crop that a new network has, pixels"""
    sizes: tuple[int, ...]
    """sides of search crops to suggest"""
    stride: int
    """pixels of the crop between two cells of the score map"""
    context: Callable[[float, float], float] = context_side
    """side of the square that a template crop shows, from the target's sides, all in pixels of the frame"""
    edge: float = 1.0
    """pixels that the sides of crop and square count less: 1 where the middles of their corner pixels coincide, 0 where
    their edges do"""
    scalars: int = 0
    """trainable values that belong to no layer"""
    presets: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """by name: share KEPT of each group"""
    rates: tuple[tuple[str, float], ...] = ()
    """regular expressions over parameters, and what multiplies the learning rate of those that match wholly"""

    def __getitem__(self, name: str) -> Layer:
        return self._by_name[name]

    @functools.cached_property
    def _by_name(self) -> dict[str, Layer]:
        return {layer.name: layer for layer in self.layers}

    @functools.cached_property
    def groups(self) -> dict[str, int]:
        """Prunable groups, in order, with their full widths."""
        return {layer.group: layer.width for layer in self.layers if layer.group}

    @functools.cached_property
    def outputs(self) -> list[Layer]:
        """Layers whose maps no other layer reads."""
        read = {name for layer in self.layers for name in layer.reads}
        return [layer for layer in self.layers if layer.name not in read]

    @functools.cached_property
    def ablation(self) -> dict[str, tuple[str, ...]]:
        """Groups that each row of the ablation prunes; the last row prunes all.

        Where the table names no rows, each group is one.
        """
        rows: dict[str, list[str]] = {}
        for layer in self.layers:
            if layer.ablation and layer.group and layer.group not in rows.setdefault(layer.ablation, []):
                rows[layer.ablation].append(layer.group)
        rows = rows or {group: [group] for group in self.groups}
        return {**{row: tuple(groups) for row, groups in rows.items()}, "everything": tuple(self.groups)}

    @functools.cached_property
    def unfreeze(self) -> dict[str, float]:
        """Share of a training run after which each layer of the backbone is trained; the last layer comes first."""
        return {layer.child: layer.thaw for layer in reversed(self.layers) if layer.thaw is not None}

    @functools.cached_property
    def views(self) -> dict[str, tuple[str, ...]]:
        """Crops that each layer sees: ``template``, ``search`` or both."""
        seen: dict[str, set[str]] = {layer.name: set() for layer in self.layers}

        def visit(name: str, view: str) -> None:
            if name == PIXELS or view in seen[name]:
                return
            seen[name].add(view)
            for number, read in enumerate(self[name].reads):
                visit(read, "template" if number and OPERATIONS[self[name].operation].crossed else view)

        for layer in self.outputs:
            visit(layer.name, "search")
        return {name: tuple(view for view in ("template", "search") if view in views) for name, views in seen.items()}

    def ties(self, group: str) -> Ties:
        """What loses channels with the filters of a group, in the order of the table."""
        carriers: dict[str, Layer] = {}
        readers: dict[str, Layer] = {}
        reached = {layer.name for layer in self.layers if layer.group == group}
        own = tuple(layer for layer in self.layers if layer.name in reached)
        for layer in self.layers:
            if reached.isdisjoint(layer.reads):
                continue
            if OPERATIONS[layer.operation].carries:
                carriers[layer.name] = layer
                reached.add(layer.name)
            else:
                readers[layer.name] = layer
        tied = [layer.name for layer in self.layers if layer in own or (layer.name in carriers and _weighted(layer))]
        hidden = {layer.reads[0] for layer in carriers.values() if _weighted(layer)}
        hidden |= {layer.reads[1] for layer in carriers.values() if OPERATIONS[layer.operation].factors}
        return Ties(
            tuple(name for name in tied if name not in hidden),
            tuple(name for name in tied if name in hidden),
            tuple(readers),
        )

    def part(self, name: str) -> list[Layer]:
        """Rows of one part of the network."""
        return [layer for layer in self.layers if layer.part == name]

    def width(self, name: str, widths: Mapping[str, int]) -> int:
        """Number of channels of a layer in a network of the given widths by group."""
        if name == PIXELS:
            return 3
        layer = self[name]
        own = widths[layer.group] if layer.group else layer.width
        if not OPERATIONS[layer.operation].carries:
            # Its own, whatever it reads: going on to the pixels would take ever longer with each sum on the way.
            return own
        return OPERATIONS[layer.operation].width(own, [self.width(read, widths) for read in layer.reads])

    def side(self, name: str, crop: int, template_size: int | None = None) -> int:
        """Side of a layer's map for a crop of ``crop`` pixels, after its pool.

        Args:
            name: of the layer, or `PIXELS`.
            crop: side of the crop; for a layer behind a correlation, of the search crop.
            template_size: side of the template crop; by default the architecture's.
        """
        if name == PIXELS:
            return crop
        layer = self[name]
        side = _before_pool(self, layer, crop, template_size or self.template_size)
        return side if layer.pool is None else -((layer.pool[0] - side) // layer.pool[1]) + 1

    def macs(self, widths: Mapping[str, int], search_size: int) -> int:
        """Multiply-accumulates of one search crop: convolutions and correlations."""
        macs = 0
        for layer, sides, side in _searched(self, search_size):
            read = [self.width(name, widths) for name in layer.reads]
            macs += OPERATIONS[layer.operation].macs(layer, sides, read, side, self.width(layer.name, widths))
        return macs

    def parameters(self, widths: Mapping[str, int]) -> int:
        """Number of trainable values: weights, a bias per filter, and scale and shift of each BatchNorm."""
        count = self.scalars
        for layer in self.layers:
            if _weighted(layer):
                width, read = self.width(layer.name, widths), [self.width(name, widths) for name in layer.reads]
                # the weights are what one cell of the map multiplies by
                weights = OPERATIONS[layer.operation].macs(layer, [], read, 1, width)
                count += weights + width * (3 if layer.bn else 1)
        return count

    def feature_size(self, side: int) -> int:
        """Side of the backbone's map for a crop of ``side`` pixels."""
        shared = [layer for layer in self.layers if len(self.views[layer.name]) == 2]
        return self.side(shared[-1].name, side)

    def score_size(self, search_size: int, template_size: int | None = None) -> int:
        """Side of the score map.

        Raises:
            UserError: the sizes leave no map, or its cells would not lie symmetrically about the crop's centre.
        """
        size = template_size or self.template_size
        hint = "try " + " or ".join(map(str, self.sizes))
        if (search_size - size) % self.stride or (search_size - self.template_size) % 2:
            raise UserError(f"search size {search_size} is not {size} plus a multiple of {self.stride}: {hint}")
        for layer, crop in itertools.product(self.layers, (size, search_size)):
            # Rounded, the grid of a pool would lie half a cell off, and graphs and network would differ.
            if layer.pool and (_before_pool(self, layer, crop, size) - layer.pool[0]) % layer.pool[1]:
                raise UserError(f"crops of {crop} pixels leave a rest in the pool of {layer.name}: {hint}")
        cells = self.side(self.outputs[0].name, search_size, size)
        if cells < 3:
            raise UserError(f"search size {search_size} leaves a score map of {cells} cells: {hint}")
        return cells

    def first_cell(self, search_size: int, cells: int | None = None) -> int:
        """Pixel of the search crop, in x and in y, at which cell 0 of the score map stands: 87 for SiamFC++.

        Args:
            search_size: side of the search crop, pixels.
            cells: side of the score map; by default the architecture's.
        """
        return (search_size - 1 - ((cells or self.score_size(search_size)) - 1) * self.stride) // 2

    def exported(self, name: str) -> str:
        """Name of a layer in exported graphs."""
        return self[name].joined or name

    @functools.cached_property
    def readers(self) -> dict[str, tuple[str, ...]]:
        """For each layer of the graphs, the convolutions that read it, through a pool or not, by their names there."""
        found: dict[str, list[str]] = {}
        for layer in self.layers:
            for read in layer.reads:
                if layer.operation == "convolution" and read != PIXELS and self[read].operation == "convolution":
                    readers = found.setdefault(self.exported(read), [])
                    readers += [self.exported(layer.name)] * (self.exported(layer.name) not in readers)
        return {name: tuple(readers) for name, readers in found.items()}


def _weighted(layer: Layer) -> bool:
    return OPERATIONS[layer.operation].weighted


@functools.lru_cache(maxsize=64)
def _searched(arch: Architecture, search_size: int) -> list[tuple[Layer, list[int], int]]:
    """Layers of the search pass, with the sides of what they read and of their maps before the pool."""
    size = arch.template_size
    return [
        (layer, _sides_read(arch, layer, search_size, size), _before_pool(arch, layer, search_size, size))
        for layer in arch.layers
        if "search" in arch.views[layer.name]
    ]


# Kept, since every sum on the way would double the work.
@functools.lru_cache(maxsize=4096)
def _before_pool(arch: Architecture, layer: Layer, crop: int, template_size: int) -> int:
    """Side of a layer's map before its pool."""
    return OPERATIONS[layer.operation].side(layer, _sides_read(arch, layer, crop, template_size))


def _sides_read(arch: Architecture, layer: Layer, crop: int, template_size: int) -> list[int]:
    """Sides of what a layer reads; the kernels of a correlation come from the template crop."""
    crops = [crop, template_size] if OPERATIONS[layer.operation].crossed else [crop] * len(layer.reads)
    return [arch.side(read, size, template_size) for read, size in zip(layer.reads, crops, strict=True)]


def architecture(name: str) -> Architecture:
    """The table of an architecture.

    Raises:
        UserError: there is none of that name; the known ones are listed.
    """
    if name not in ARCHITECTURES:
        known = ", ".join(ARCHITECTURES)
        raise UserError(f"unknown architecture {name!r}: known are {known}; import the module that adds it first")
    found: Architecture = importlib.import_module(ARCHITECTURES[name]).ARCHITECTURE
    return found


def by_depth(layers: Iterable[Layer]) -> list[Layer]:
    """Layers ordered by how many others of them they stand behind, so that branches advance side by side."""
    known, depth = {layer.name: layer for layer in layers}, dict[str, int]()
    for layer in known.values():
        depth[layer.name] = 1 + max((depth.get(read, 0) for read in layer.reads), default=0)
    return [known[name] for name in sorted(depth, key=depth.__getitem__)]


def walk(layers: Iterable[Layer], maps: Mapping[str, Output], apply: Callable[..., Output]) -> dict[str, Output]:
    """Run layers in the given order, whatever stands for their maps.

    Args:
        layers: rows, each behind what it reads.
        maps: what is there before, by name.
        apply: gives a layer's map from the layer and the maps that it reads.

    Returns:
        The maps given and made, by name.
    """
    found = dict(maps)
    for layer in layers:
        found[layer.name] = apply(layer, *(found[read] for read in layer.reads))
    return found


def opened(path: str) -> Any:
    """What an import path ``module:name``, or ``module``, of a table stands for."""
    module, _, name = path.partition(":")
    found = importlib.import_module(module)
    return getattr(found, name) if name else found

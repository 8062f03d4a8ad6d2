"""Rows of a table as nodes of a graph, one by one; in 8 bits, every map that an integer layer reads is rounded once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np

from psiamfcpp.export.builder import Builder
from psiamfcpp.export.layers import Layer
from psiamfcpp.models import arch
from psiamfcpp.models.arch import OPERATIONS, walk

_OPERATORS = {"sum": "Add", "gate": "Mul", "mean": "GlobalAveragePool"}
# Which of them compute on integers, where what they give is read as such.
_INTEGER = ("sum", "gate", "join")
# Filters that are computed at a time.
_FILTERS = 16


def append(
    graph: Builder, rows: Iterable[arch.Layer], maps: Mapping[str, str], cells: Callable[[arch.Layer, str], str]
) -> dict[str, str]:
    """Append rows to a graph.

    Args:
        graph: to append to.
        rows: each behind what it reads.
        maps: tensors that are there before, by row.
        cells: appends a row that correlates cell by cell, from row and features.

    Returns:
        The tensors given and made, by row. A map in 8 bits is that for all who read it.
    """
    rows = list(rows)
    rounded = _rounded(graph, rows)

    def apply(row: arch.Layer, *read: str) -> str:
        out = cells(row, read[0]) if row.operation == "cells" else _row(graph, row, *read)
        return graph.rounded(out, graph.ranges.rows[row.name]) if row.name in rounded else out

    return walk(rows, maps, apply)


def _rounded(graph: Builder, rows: list[arch.Layer]) -> set[str]:
    """Names of the maps in 8 bits: those that integer layers read and give, and what such a sum, gate or join reads."""
    found: set[str] = set()
    for row in reversed(rows):
        if row.name in graph.ranges.inputs:
            found |= {row.name, *row.reads}
        elif row.name in found and row.operation in _INTEGER:
            found.update(row.reads)
    return found


def filled_up(ragged: Mapping[str, Layer], table: arch.Architecture) -> dict[str, Layer]:
    """Return the same function, the widths that pruning leaves filled up with filters of zeros to a multiple of 16.

    Filters are computed 16 at a time: LightFC cut to widths of 16 n - 1 takes 1.7 times as long in 8 bits and 1.5
    times in float as filled up.
    """
    even, extra = dict(ragged), {arch.PIXELS: 0}
    for row in table.layers:
        read = extra[row.reads[0]]
        if row.operation != "convolution":
            extra[row.name] = read if row.operation in ("depthwise", *_OPERATORS) else 0
        else:
            extra[row.name] = -len(ragged[row.name].bias) % _FILTERS if row.group else 0
        if OPERATIONS[row.operation].weighted:
            own, more = ragged[row.name], extra[row.name]
            inputs = read if row.operation == "convolution" else 0
            even[row.name] = Layer(
                np.pad(own.weight, [(0, more), (0, inputs), (0, 0), (0, 0)]),
                np.pad(own.gain, (0, more), constant_values=1),
                np.pad(own.bias, (0, more)),
            )
    return even


def may_be_integer(row: arch.Layer) -> bool:
    """Tell whether a layer can give integers: nothing but a limit comes between its sums and its map."""
    return OPERATIONS[row.operation].weighted and row.activation in (None, "relu6")


def tensor(row: arch.Layer) -> str:
    """Name of a row's map in a graph, before it is rounded."""
    activation = "relu" if row.relu else row.activation
    return f"{row.name}.{activation}" if activation else row.name


def _row(graph: Builder, row: arch.Layer, *read: str) -> str:
    if row.operation == "join":
        return str(graph.add("Concat", *read, name=row.name, axis=1))
    if not OPERATIONS[row.operation].weighted:
        return str(graph.add(_OPERATORS[row.operation], *read, name=row.name))
    groups = len(graph.layers[row.name].bias) if row.operation == "depthwise" else 1
    out = graph.conv(row.name, read[0], row.relu, row.stride, row.padding, groups)
    return _ACTIVATIONS[row.activation](graph, out, tensor(row)) if row.activation else out


def within(graph: Builder, x: str, low: float, high: float, name: str = "") -> str:
    """A tensor clipped to bounds."""
    return str(graph.add("Clip", x, *(graph.constant(np.float32(bound)) for bound in (low, high)), name=name))


def _gelu(graph: Builder, x: str, name: str) -> str:
    """GELU by the error function; ONNX has it as one operator only since opset 20."""
    half, one, root = (graph.constant(np.float32(value)) for value in (0.5, 1.0, 0.5**0.5))
    share = graph.add("Add", graph.add("Erf", graph.add("Mul", x, root)), one)
    return str(graph.add("Mul", graph.add("Mul", x, half), share, name=name))


_ACTIVATIONS: Mapping[str, Callable[[Builder, str, str], str]] = {
    "relu6": lambda graph, x, name: within(graph, x, 0.0, 6.0, name),
    "gelu": _gelu,
    "sigmoid": lambda graph, x, name: str(graph.add("Sigmoid", x, name=name)),
}

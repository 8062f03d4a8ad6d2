"""The graphs of LightFC, in float and in 8 bits."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
import onnx
from onnx import TensorProto, helper

from psiamfcpp.export.builder import Builder, Ranges, two_by_two
from psiamfcpp.export.compact import compact
from psiamfcpp.export.layers import Layer, divided, folded
from psiamfcpp.export.rows import append, filled_up, within
from psiamfcpp.models import arch
from psiamfcpp.models.arch import PIXELS
from psiamfcpp.models.lightfc import MARGIN, MEAN, LightFC
from psiamfcpp.spec import ModelSpec

# What the template graph gives: the features of its crop.
_KERNEL = "kernel"
# Parts that stay in float. The fusion has 1 % of the multiply-adds; in 8 bits it takes no less time, and of all layers
# its own change the boxes most.
FLOAT = ("fusion",)
# What stands for black in the integers of the first layer: the grey nearest to the mean colour, so that what rounding
# its weights costs is not multiplied by the mean.
_GREY = round(sum(MEAN) / 3)


def layers(model: LightFC) -> dict[str, Layer]:
    """See `psiamfcpp.export.layers.layers`."""
    return filled_up(folded(model), model.spec.arch)


def template_graph(spec: ModelSpec, layers: Mapping[str, Layer], ranges: Ranges) -> onnx.ModelProto:
    """The graph ``crop (1, 128, 128, 3) uint8 BGR -> kernel (1, C, 8, 8)``.

    It computes in float, since it runs once and every frame rests on it. Where the search graph is quantized, its
    weights are stored in 8 bits.
    """
    graph = Builder(layers, Ranges())
    rows = spec.arch.part("backbone")
    maps = _append(graph, rows)
    crop = helper.make_tensor_value_info("crop", TensorProto.UINT8, [1, spec.template_size, spec.template_size, 3])
    made = graph.model(spec, [crop], {_KERNEL: (maps[rows[-1].name], TensorProto.FLOAT, _kernel_shape(spec))})
    return compact(made) if ranges.inputs else made


def search_graph(spec: ModelSpec, layers: Mapping[str, Layer], ranges: Ranges) -> onnx.ModelProto:
    """The graph ``crop (1, S, S, 3) uint8 BGR, kernel -> scores (1, N, N), boxes (1, N, N, 4)``; S is free."""
    readers = {name: [row.name for row in spec.arch.layers if name in row.reads] for name in ranges.factors}
    graph = Builder(divided(layers, ranges.factors, readers), ranges)
    maps = _append(graph, spec.arch.layers)
    score, size = (within(graph, maps[f"head.{name}"], MARGIN, 1 - MARGIN) for name in ("score", "size"))
    scores = graph.add("Squeeze", score, graph.constant(np.array([1])))
    inputs = [
        helper.make_tensor_value_info("crop", TensorProto.UINT8, [1, "size", "size", 3]),
        helper.make_tensor_value_info(_KERNEL, TensorProto.FLOAT, _kernel_shape(spec)),
    ]
    outputs = {
        "scores": (scores, TensorProto.FLOAT, [1, "cells", "cells"]),
        "boxes": (_boxes(graph, size, maps["head.offset"], spec), TensorProto.FLOAT, [1, "cells", "cells", 4]),
    }
    return graph.model(spec, inputs, outputs)


def _kernel_shape(spec: ModelSpec) -> list[int]:
    side, features = spec.arch.feature_size(spec.template_size), spec.arch.part("backbone")[-1].name
    return [1, spec.arch.width(features, spec.widths), side, side]


def _append(graph: Builder, rows: tuple[arch.Layer, ...] | list[arch.Layer]) -> dict[str, str]:
    """Append rows, the first of which reads the input ``crop``; their maps."""
    first, *others = rows
    x, first = _integer_pixels(graph, first) if first.name in graph.ranges.inputs else (_pixels(graph), first)
    return append(graph, [first, *others], {PIXELS: x}, lambda row, features: _cells(graph, row.name, features))


def _pixels(graph: Builder) -> str:
    x = graph.add("Transpose", "crop", name="pixels", perm=[0, 3, 1, 2])
    x = graph.add("Cast", x, to=TensorProto.FLOAT)
    # Before the first layer and not in its bias: its padding is the mean colour.
    return str(graph.add("Sub", x, graph.constant(np.array(MEAN, np.float32).reshape(1, 3, 1, 1))))


def _integer_pixels(graph: Builder, first: arch.Layer) -> tuple[str, arch.Layer]:
    """Return the pixels as integers, and the first layer on them; its padding is the mean colour, rounded.

    Two by two pixels are one of twelve channels, since that has half as many rows to gather, as in SiamFC++'s graphs.
    """
    layer, mean = graph.layers[first.name], np.array(MEAN, np.float32)
    folded = layer.weight * layer.gain[:, None, None, None]
    bias = layer.bias - folded.sum(axis=(2, 3)) @ (mean - _GREY)
    # The row and the column of zeros come last: the first filter row meets the padding above the first pixel.
    weight = np.pad(layer.weight, [(0, 0), (0, 0), (0, 1), (0, 1)]).reshape(-1, 3, 2, 2, 2, 2)
    weight = weight.transpose(0, 3, 5, 1, 2, 4).reshape(-1, 12, 2, 2)
    graph.layers = {**graph.layers, first.name: dataclasses.replace(layer, weight=weight, bias=bias)}
    x = graph.from_uint8(two_by_two(graph, _bordered(graph)), np.float32(1), _GREY)
    return x, dataclasses.replace(first, stride=1, padding=0)


def _bordered(graph: Builder) -> str:
    """The crop with a border of one pixel in the mean colour: ``(1, S + 2, S + 2, 3)``."""
    colour = graph.constant(np.rint(MEAN).astype(np.uint8).reshape(1, 1, 1, 3), "mean_colour")
    one, two = (graph.constant(np.array([v])) for v in (1, 2))
    side = graph.add("Shape", "crop", start=1, end=2)
    column = graph.add("Expand", colour, graph.add("Concat", one, side, one, one, axis=0))
    x = graph.add("Concat", column, "crop", column, axis=2)
    row = graph.add("Expand", colour, graph.add("Concat", one, one, graph.add("Add", side, two), one, axis=0))
    return str(graph.add("Concat", row, x, row, axis=1))


def _cells(graph: Builder, name: str, features: str) -> str:
    """Correlate cell by cell: a convolution of one pixel, whose filters are the cells of the template."""
    cells = graph.add("Reshape", _KERNEL, graph.constant(np.array([0, 0, -1])))
    cells = graph.add("Transpose", cells, perm=[2, 1, 0])
    weight = graph.add("Unsqueeze", cells, graph.constant(np.array([3])))
    return str(graph.add("Conv", features, weight, name=name, kernel_shape=[1, 1]))


def _boxes(graph: Builder, size: str, offset: str, spec: ModelSpec) -> str:
    """Boxes ``(1, N, N, 4)`` in pixels of the crop, as `psiamfcpp.models.lightfc.to_boxes`."""
    zero, one = graph.constant(np.array(0)), graph.constant(np.array(1))
    count = graph.add("Squeeze", graph.add("Shape", size, start=2, end=3), graph.constant(np.array([0])))
    line = graph.add("Cast", graph.add("Range", zero, count, one), to=TensorProto.FLOAT)
    # x changes along the row and y down the column.
    along = graph.add("Reshape", line, graph.constant(np.array([1, 1, 1, -1])))
    down = graph.add("Reshape", line, graph.constant(np.array([1, 1, -1, 1])))
    is_x, is_y = (graph.constant(np.array(v, np.float32).reshape(1, 2, 1, 1)) for v in ([1, 0], [0, 1]))
    grid = graph.add("Add", graph.add("Mul", along, is_x), graph.add("Mul", down, is_y))
    stride = graph.constant(np.float32(spec.arch.stride))
    centres = graph.add("Mul", graph.add("Add", grid, offset), stride)
    half = graph.add("Mul", size, graph.constant(np.float32(spec.arch.search_size / 2)))
    last = graph.add("Sub", graph.add("Add", centres, half), graph.constant(np.float32(1)))
    corners = graph.add("Concat", graph.add("Sub", centres, half), last, axis=1)
    return str(graph.add("Transpose", corners, perm=[0, 2, 3, 1]))

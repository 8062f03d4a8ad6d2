"""The graphs of LightFC, in float."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import onnx
from onnx import TensorProto, helper

from psiamfcpp.errors import UserError
from psiamfcpp.export.builder import Builder, Ranges
from psiamfcpp.export.layers import Layer, folded
from psiamfcpp.models import arch
from psiamfcpp.models.arch import PIXELS, walk
from psiamfcpp.models.lightfc import MARGIN, MEAN, LightFC
from psiamfcpp.spec import ModelSpec

# What the template graph gives: the features of its crop.
_KERNEL = "kernel"


def layers(model: LightFC) -> dict[str, Layer]:
    """See `psiamfcpp.export.layers.layers`."""
    return folded(model)


def template_graph(spec: ModelSpec, layers: Mapping[str, Layer], ranges: Ranges) -> onnx.ModelProto:
    """The graph ``crop (1, 128, 128, 3) uint8 BGR -> kernel (1, C, 8, 8)``."""
    graph = _builder(layers, ranges)
    crop = helper.make_tensor_value_info("crop", TensorProto.UINT8, [1, spec.template_size, spec.template_size, 3])
    return graph.model(spec, [crop], {_KERNEL: (_features(graph, spec), TensorProto.FLOAT, _kernel_shape(spec))})


def search_graph(spec: ModelSpec, layers: Mapping[str, Layer], ranges: Ranges) -> onnx.ModelProto:
    """The graph ``crop (1, S, S, 3) uint8 BGR, kernel -> scores (1, N, N), boxes (1, N, N, 4)``; S is free."""
    graph = _builder(layers, ranges)
    features = spec.arch.part("backbone")[-1].name
    known = {features: _features(graph, spec)}
    maps = walk((row for row in spec.arch.layers if row.part != "backbone"), known, lambda *a: _operation(graph, *a))
    score, size = (_within(graph, maps[f"head.{name}"], MARGIN, 1 - MARGIN) for name in ("score", "size"))
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


def _builder(layers: Mapping[str, Layer], ranges: Ranges) -> Builder:
    if ranges.inputs:
        raise UserError("LightFC is exported in float only: leave out --int8")
    return Builder(layers, ranges)


def _kernel_shape(spec: ModelSpec) -> list[int]:
    side, features = spec.arch.feature_size(spec.template_size), spec.arch.part("backbone")[-1].name
    return [1, spec.arch.width(features, spec.widths), side, side]


def _features(graph: Builder, spec: ModelSpec) -> str:
    """Features of the input ``crop``."""
    x = graph.add("Transpose", "crop", name="pixels", perm=[0, 3, 1, 2])
    x = graph.add("Cast", x, to=TensorProto.FLOAT)
    # Before the first layer and not in its bias: its padding is the mean colour.
    x = graph.add("Sub", x, graph.constant(np.array(MEAN, np.float32).reshape(1, 3, 1, 1)))
    rows = spec.arch.part("backbone")
    return walk(rows, {PIXELS: x}, lambda *given: _operation(graph, *given))[rows[-1].name]


def _operation(graph: Builder, row: arch.Layer, *read: str) -> str:
    """Append one row of the table; its map."""
    if row.operation == "cells":
        return _cells(graph, row.name, read[0])
    if row.operation == "join":
        return str(graph.add("Concat", *read, name=row.name, axis=1))
    plain = {"sum": "Add", "gate": "Mul", "mean": "GlobalAveragePool"}
    if row.operation in plain:
        return str(graph.add(plain[row.operation], *read, name=row.name))
    groups = len(graph.layers[row.name].bias) if row.operation == "depthwise" else 1
    out = graph.conv(row.name, read[0], row.relu, row.stride, row.padding, groups)
    if row.activation == "relu6":
        return _within(graph, out, 0.0, 6.0)
    if row.activation == "gelu":
        return _gelu(graph, out)
    return str(graph.add("Sigmoid", out)) if row.activation == "sigmoid" else out


def _cells(graph: Builder, name: str, features: str) -> str:
    """Correlate cell by cell: a convolution of one pixel, whose filters are the cells of the template."""
    cells = graph.add("Reshape", _KERNEL, graph.constant(np.array([0, 0, -1])))
    cells = graph.add("Transpose", cells, perm=[2, 1, 0])
    weight = graph.add("Unsqueeze", cells, graph.constant(np.array([3])))
    return str(graph.add("Conv", features, weight, name=name, kernel_shape=[1, 1]))


def _within(graph: Builder, x: str, low: float, high: float) -> str:
    return str(graph.add("Clip", x, *(graph.constant(np.float32(bound)) for bound in (low, high))))


def _gelu(graph: Builder, x: str) -> str:
    """GELU by the error function; ONNX has it as one operator only since opset 20."""
    half, one, root = (graph.constant(np.float32(value)) for value in (0.5, 1.0, 0.5**0.5))
    share = graph.add("Add", graph.add("Erf", graph.add("Mul", x, root)), one)
    return str(graph.add("Mul", graph.add("Mul", x, half), share))


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
    side = graph.add("Cast", graph.add("Shape", "crop", start=1, end=2), to=TensorProto.FLOAT)
    half = graph.add("Mul", size, graph.add("Mul", side, graph.constant(np.float32(0.5))))
    last = graph.add("Sub", graph.add("Add", centres, half), graph.constant(np.float32(1)))
    corners = graph.add("Concat", graph.add("Sub", centres, half), last, axis=1)
    return str(graph.add("Transpose", corners, perm=[0, 2, 3, 1]))

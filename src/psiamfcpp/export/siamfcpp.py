"""The graphs of SiamFC++: what is folded in them, the correlation, and the boxes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper

from psiamfcpp.errors import UserError
from psiamfcpp.export.builder import Builder, Ranges, two_by_two
from psiamfcpp.export.layers import Layer, divided, filled_up, folded
from psiamfcpp.models import arch
from psiamfcpp.models.arch import by_depth, walk
from psiamfcpp.models.network import SiamFCpp
from psiamfcpp.spec import ModelSpec

# Step and zero of 8 bits that hold -1 to 1.
_EVEN = np.float32(1 / 127), 128
# What the network clamps the logarithm of distances to, see `psiamfcpp.models.network.Head`.
_MAX_LOG = 6.0


def layers(model: SiamFCpp) -> dict[str, Layer]:
    """See `psiamfcpp.export.layers.layers`; the two scalars of the head are folded into its last layer."""
    found = folded(model)
    offsets = found["head.reg_offsets"]
    si, bi = np.float32(model.head.si.item()), np.float32(model.head.bi.item())
    found["head.reg_offsets"] = Layer(offsets.weight, offsets.gain * si, offsets.bias * si + bi)
    return filled_up(found, model.spec.arch)


def template_graph(spec: ModelSpec, layers: Mapping[str, Layer], ranges: Ranges) -> onnx.ModelProto:
    """The graph ``crop (1, 127, 127, 3) uint8 BGR -> cls_kernel, reg_kernel (1, C, 4, 4)``.

    It is quantized as the search graph is: one bit of a kernel may decide between two like objects, so every processor
    must give the same.
    """
    graph = Builder(divided(layers, ranges.factors, spec.arch.readers), ranges)
    x, kernel = _backbone(graph, spec), _kernel(spec)
    # All neck layers read the same map.
    bounds = ranges.inputs.get("neck.search")
    side = spec.template_size
    outputs = {
        f"{branch}_kernel": (
            graph.exact(name, x, bounds) if bounds else graph.conv(name, x, relu=False),
            TensorProto.FLOAT,
            [1, spec.widths[f"neck.{branch}"], kernel, kernel],
        )
        for branch, name in ((branch, f"neck.{branch}_template") for branch in ("cls", "reg"))
    }
    crop = helper.make_tensor_value_info("crop", TensorProto.UINT8, [1, side, side, 3])
    return graph.model(spec, [crop], outputs)


def search_graph(spec: ModelSpec, layers: Mapping[str, Layer], ranges: Ranges) -> onnx.ModelProto:
    """The graph ``crop (1, S, S, 3) uint8 BGR, cls_kernel, reg_kernel -> scores (1, N, N), boxes (1, N, N, 4)``.

    Boxes are x0, y0, x1, y1 in pixels of the crop; S is free.
    """
    graph = Builder(divided(layers, ranges.factors, spec.arch.readers), ranges)
    cls, reg = _correlation(graph, spec)
    hidden = by_depth(row for row in spec.arch.part("head") if row.group)
    maps = walk(hidden, {"cls": cls, "reg": reg}, graph.layer)
    both = graph.add("Sigmoid", graph.conv("head.scores", maps["head.cls3"], relu=False))
    scores = graph.add("ReduceProd", both, axes=[1], keepdims=0)
    boxes = _boxes(graph, spec.arch.stride, scores, graph.conv("head.reg_offsets", maps["head.reg3"], relu=False))
    inputs = [helper.make_tensor_value_info("crop", TensorProto.UINT8, [1, "size", "size", 3])]
    for branch in ("cls", "reg"):
        shape = [1, spec.widths[f"neck.{branch}"], _kernel(spec), _kernel(spec)]
        inputs.append(helper.make_tensor_value_info(f"{branch}_kernel", TensorProto.FLOAT, shape))
    outputs = {
        "scores": (scores, TensorProto.FLOAT, [1, "cells", "cells"]),
        "boxes": (boxes, TensorProto.FLOAT, [1, "cells", "cells", 4]),
    }
    return graph.model(spec, inputs, outputs)


def _kernel(spec: ModelSpec) -> int:
    """Side of the correlation's kernel: 4 for a template crop of 127 pixels."""
    return spec.arch.side("neck.cls_template", spec.template_size)


def _backbone(graph: Builder, spec: ModelSpec) -> str:
    """Features of the input ``crop``."""
    first, *others = spec.arch.part("backbone")
    x = graph.pooled(first, _first(graph, first))
    return walk(others, {first.name: x}, graph.layer)[others[-1].name]


def _first(graph: Builder, first: arch.Layer) -> str:
    """The first layer, before its pool."""
    name = first.name
    if name not in graph.ranges.inputs:
        x = graph.add("Transpose", "crop", name="pixels", perm=[0, 3, 1, 2])
        x = graph.add("Cast", x, to=TensorProto.FLOAT)
        return graph.conv(name, x, relu=first.relu, stride=first.stride)
    if first.stride != 2 or first.kernel % 2 == 0 or first.padding:
        raise UserError(f"{name} has no 8-bit form: that of an odd kernel at stride 2 without padding is known")
    # In integers the time goes into gathering what each filter sees, row by row. With two by two pixels as one,
    # of twelve channels and at stride 1, there are half as many rows.
    layer, side = graph.layers[name], (first.kernel + 1) // 2
    weight = np.pad(layer.weight, [(0, 0), (0, 0), (0, 1), (0, 1)]).reshape(-1, 3, side, 2, side, 2)
    weight = weight.transpose(0, 3, 5, 1, 2, 4).reshape(-1, 12, side, side)
    graph.layers = {**graph.layers, name: dataclasses.replace(layer, weight=weight)}
    return graph.conv(name, two_by_two(graph, _bordered(graph)), relu=first.relu)


def _bordered(graph: Builder) -> str:
    """The crop with a row and a column added at its end, which makes its side even."""
    edge = graph.constant(np.array([0, 0, 0, 0, 0, 1, 1, 0]))
    return str(graph.add("Pad", "crop", edge, graph.constant(np.uint8(0))))


def _correlation(graph: Builder, spec: ModelSpec) -> tuple[str, str]:
    """Both depth-wise correlations in one grouped convolution, which is the fastest way in onnxruntime and OpenVINO.

    Its weight is an input, so its groups are fixed and the batch is one: `benchmarks/correlation.py` has the others.
    """
    widths, side = [spec.widths["neck.cls"], spec.widths["neck.reg"]], _kernel(spec)
    kernels = graph.add("Concat", "cls_kernel", "reg_kernel", axis=1)
    kernels = graph.add("Reshape", kernels, graph.constant(np.array([-1, 1, side, side])))
    split = graph.constant(np.array(widths))
    ranges = graph.ranges
    if "neck.search" in ranges.inputs and ranges.features is not None and ranges.maps is not None:
        maps = _integer_correlation(graph, spec, kernels, ranges.features, ranges.maps)
        cls, reg = graph.add("Split", maps, split, name="branches", outputs=2, axis=1)
        return graph.from_uint8(cls, *_EVEN), graph.from_uint8(reg, *_EVEN)
    features = graph.conv("neck.search", _backbone(graph, spec), relu=False)
    maps = graph.add("Conv", features, kernels, name="correlation", group=sum(widths), kernel_shape=[side, side])
    cls, reg = graph.add("Split", maps, split, name="branches", outputs=2, axis=1)
    return cls, reg


def _integer_correlation(
    graph: Builder, spec: ModelSpec, kernels: str, features: NDArray[np.float32], maps: NDArray[np.float32]
) -> str:
    """The correlation of ``kernels (C, 1, 4, 4)``, float, in integers; its maps in 8 bits.

    Every channel uses all of its 8 bits: the neck's weights bring its features to one range, the kernels' steps,
    taken from the kernels of the target at hand, bring its map to one range, and the head's first weights undo it.
    """
    features, maps = np.maximum(features, 1e-6), np.maximum(maps, 1e-6)
    neck, cls, reg = (graph.layers[name] for name in ("neck.search", "head.cls1", "head.reg1"))
    of_cls, of_reg = maps[: cls.weight.shape[1], None, None], maps[cls.weight.shape[1] :, None, None]
    changed = {
        "neck.search": dataclasses.replace(neck, gain=neck.gain / features, bias=neck.bias / features),
        "head.cls1": dataclasses.replace(cls, weight=cls.weight * of_cls),
        "head.reg1": dataclasses.replace(reg, weight=reg.weight * of_reg),
    }
    graph.layers = {**graph.layers, **changed}

    peaks = graph.add("ReduceMax", graph.add("Abs", kernels), axes=[1, 2, 3], keepdims=0)
    # a channel without any kernel must not divide by zero
    steps = graph.add("Mul", graph.add("Max", peaks, graph.constant(np.float32(1e-12))), graph.constant(_EVEN[0]))
    zeros = graph.constant(np.zeros(len(maps), np.int8), "kernel_zero")
    whole = graph.add("QuantizeLinear", kernels, steps, zeros, axis=0)
    steps = graph.add("Mul", steps, graph.constant(features / maps, "kernel_range"))
    kernels = graph.add("DequantizeLinear", whole, steps, zeros, axis=0)

    x = graph.conv("neck.search", _backbone(graph, spec), relu=False)
    x = graph.from_uint8(graph.to_uint8(x, *_EVEN), *_EVEN)
    x = graph.add("Conv", x, kernels, name="correlation", group=len(maps), kernel_shape=[_kernel(spec)] * 2)
    return graph.to_uint8(x, *_EVEN)


def _boxes(graph: Builder, pixels: int, scores: str, logs: str) -> str:
    """Boxes ``(1, N, N, 4)`` from the logarithms of distances ``(1, 4, N, N)`` in strides of some pixels."""
    cells = graph.add("Shape", scores, start=1, end=2)
    size = graph.add("Shape", "crop", start=1, end=2)
    one, two, stride = (graph.constant(np.array([v])) for v in (1, 2, pixels))
    # first = (size - 1 - (cells - 1) * stride) // 2, as `psiamfcpp.models.arch.Architecture.first_cell`
    span = graph.add("Mul", graph.add("Sub", cells, one), stride)
    first = graph.add("Div", graph.add("Sub", graph.add("Sub", size, one), span), two)
    zero = graph.constant(np.array(0))
    count = graph.add("Squeeze", cells, graph.constant(np.array([0])))
    steps = graph.add("Mul", graph.add("Range", zero, count, graph.constant(np.array(1))), stride)
    line = graph.add("Cast", graph.add("Add", steps, first), to=TensorProto.FLOAT)
    # x changes along the row and y down the column; each serves two of the four sides
    along = graph.add("Reshape", line, graph.constant(np.array([1, 1, -1, 1])))
    down = graph.add("Reshape", line, graph.constant(np.array([1, -1, 1, 1])))
    is_x = graph.constant(np.array([1, 0, 1, 0], np.float32))
    is_y = graph.constant(np.array([0, 1, 0, 1], np.float32))
    grid = graph.add("Add", graph.add("Mul", along, is_x), graph.add("Mul", down, is_y))
    logs = graph.add("Transpose", logs, perm=[0, 2, 3, 1])
    strides = graph.add("Exp", graph.add("Min", logs, graph.constant(np.array(_MAX_LOG, np.float32))))
    outward = graph.constant(np.array([-pixels, -pixels, pixels, pixels], np.float32))
    return graph.add("Add", grid, graph.add("Mul", strides, outward))

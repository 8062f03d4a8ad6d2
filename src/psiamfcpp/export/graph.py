"""The two graphs of a model, `template` and `search`, built node by node so that everything is in them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from psiamfcpp.export.layers import Layer, divided
from psiamfcpp.runtime.graph_file import GRAPH_FORMAT
from psiamfcpp.spec import STRIDE, ModelSpec

# The correlation's kernel is 4x4: a template crop of 127 pixels after the backbone and one layer of the neck.
KERNEL = 4
_OPSET = 17
# IR version of the oldest onnxruntime that the package allows.
_IR_VERSION = 8
# Step and zero of 8 bits that hold -1 to 1.
_EVEN = np.float32(1 / 127), 128
# What the network clamps the logarithm of distances to, see `psiamfcpp.models.network.Head`.
_MAX_LOG = 6.0


@dataclass(frozen=True)
class Ranges:
    """What 8 bits must tell apart: nothing, unless said."""

    inputs: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """lowest and highest input of each layer that is to be quantized; the other layers stay float"""
    features: NDArray[np.float32] | None = None
    """``(C,)``: largest magnitude of each channel of ``neck.search``, if that layer is among them"""
    maps: NDArray[np.float32] | None = None
    """``(C,)``: the same of what the correlation makes of these channels"""
    factors: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    """what the output channels of layers are divided by, before the ranges above were taken"""


@dataclass
class _Graph:
    """A graph in the making; names of tensors are strings."""

    layers: Mapping[str, Layer]
    ranges: Ranges
    nodes: list[Any] = field(default_factory=list)
    constants: dict[str, Any] = field(default_factory=dict)
    steps: dict[str, np.float32] = field(default_factory=dict)
    """of tensors that come straight from 8 bits"""

    def add(self, op: str, *inputs: str, name: str = "", outputs: int = 1, **attributes: Any) -> Any:
        """Append a node; the name of its output, or a tuple of them."""
        name = name or f"{op}_{len(self.nodes)}"
        out = [name] if outputs == 1 else [f"{name}_{i}" for i in range(outputs)]
        self.nodes.append(helper.make_node(op, list(inputs), out, name=name, **attributes))
        return out[0] if outputs == 1 else tuple(out)

    def constant(self, value: Any, name: str = "") -> str:
        """Store a constant; its name."""
        array = np.asarray(value)
        name = name or f"{array.dtype}_{array.tolist()}"
        self.constants[name] = numpy_helper.from_array(array, name)
        return name

    def conv(self, name: str, x: str, relu: bool, stride: int = 1) -> str:
        """The layer of that name, quantized if its input's range is known."""
        layer = self.layers[name]
        if name in self.ranges.inputs:
            x, weight, bias = self._quantized(name, x, layer)
        else:
            weight, bias = self._half(name, layer), self.constant(layer.bias, f"{name}.bias")
        out = self.add("Conv", x, weight, bias, name=name, strides=[stride, stride])
        return self.add("Relu", out, name=f"{name}.relu") if relu else out

    def _half(self, name: str, layer: Layer) -> str:
        """A float weight stored in 16 bits: the runtime multiplies it out once, at load."""
        # A power of two for each filter keeps all of a half-precision checkpoint's bits.
        peak = np.abs(layer.weight).max(axis=(1, 2, 3), keepdims=True)
        power = np.exp2(np.floor(np.log2(np.maximum(peak, 1e-30)))).astype(np.float32)
        half = self.constant((layer.weight / power).astype(np.float16), f"{name}.weight")
        scale = self.constant(power * layer.gain[:, None, None, None], f"{name}.scale")
        return self.add("Mul", self.add("Cast", half, to=TensorProto.FLOAT), scale)

    def _quantized(self, name: str, x: str, layer: Layer) -> tuple[str, str, str]:
        """Input, weight and bias of a layer as what is left after eight bits."""
        if x not in self.steps:
            low, high = (f(bound, 0.0) for f, bound in zip((min, max), self.ranges.inputs[name], strict=True))
            step = np.float32(max((high - low) / 255, 1e-8))
            zero = round(-low / float(step))
            x = self.from_uint8(self.to_uint8(x, step, zero), step, zero)
        folded = layer.weight * layer.gain[:, None, None, None]
        steps = np.maximum(np.abs(folded).max(axis=(1, 2, 3)) / 127, 1e-12).astype(np.float32)
        rounded = np.rint(folded / steps[:, None, None, None]).astype(np.int8)
        weight = self.add(
            "DequantizeLinear",
            self.constant(rounded, f"{name}.weight"),
            self.constant(steps, f"{name}.weight_scale"),
            self.constant(np.zeros(len(steps), np.int8), f"{name}.weight_zero"),
            axis=0,
        )
        bias_steps = (steps * self.steps[x]).astype(np.float32)
        limit = 2**31 - 1
        bias = self.add(
            "DequantizeLinear",
            self.constant(np.rint(layer.bias / bias_steps).clip(-limit, limit).astype(np.int32), f"{name}.bias"),
            self.constant(bias_steps, f"{name}.bias_scale"),
            self.constant(np.zeros(len(steps), np.int32), f"{name}.bias_zero"),
            axis=0,
        )
        return x, weight, bias

    def to_uint8(self, x: str, step: np.float32, zero: int) -> str:
        """A tensor in eight bits; pixels are that already."""
        if x == "pixels":
            return x
        return self.add("QuantizeLinear", x, self.constant(step), self.constant(np.uint8(zero)))

    def from_uint8(self, x: str, step: np.float32, zero: int) -> str:
        """What eight bits stand for."""
        x = self.add("DequantizeLinear", x, self.constant(step), self.constant(np.uint8(zero)))
        self.steps[x] = step
        return x

    def backbone(self) -> str:
        """Features of the input ``crop``."""
        # Pools round up in the network; at the sizes that a spec allows there is nothing to round.
        pool: dict[str, Any] = {"kernel_shape": [3, 3], "strides": [2, 2]}
        x = self.add("MaxPool", self.first(), name="backbone.pool1", **pool)
        x = self.add("MaxPool", self.conv("backbone.conv2", x, relu=True), name="backbone.pool2", **pool)
        x = self.conv("backbone.conv3", x, relu=True)
        x = self.conv("backbone.conv4", x, relu=True)
        return self.conv("backbone.conv5", x, relu=False)

    def first(self) -> str:
        """The first layer."""
        name = "backbone.conv1"
        if name not in self.ranges.inputs:
            x = self.add("Transpose", "crop", name="pixels", perm=[0, 3, 1, 2])
            return self.conv(name, self.add("Cast", x, to=TensorProto.FLOAT), relu=True, stride=2)
        # In integers the time goes into gathering what each filter sees, row by row. With two by two pixels as one,
        # of twelve channels and at stride 1, there are half as many rows.
        layer = self.layers[name]
        weight = np.pad(layer.weight, [(0, 0), (0, 0), (0, 1), (0, 1)]).reshape(-1, 3, 6, 2, 6, 2)
        weight = weight.transpose(0, 3, 5, 1, 2, 4).reshape(-1, 12, 6, 6)
        self.layers = {**self.layers, name: dataclasses.replace(layer, weight=weight)}
        return self.conv(name, self._two_by_two(), relu=True)

    def _two_by_two(self) -> str:
        """The crop as ``(1, 12, (S + 1) / 2, (S + 1) / 2)``; S is odd, so a row and a column are added."""
        one, two, six = (self.constant(np.array([v])) for v in (1, 2, 6))
        half = self.add("Div", self.add("Add", self.add("Shape", "crop", start=1, end=2), one), two)
        edge = self.constant(np.array([0, 0, 0, 0, 0, 1, 1, 0]))
        x = self.add("Pad", "crop", edge, self.constant(np.uint8(0)))
        x = self.add("Reshape", x, self.add("Concat", one, half, two, self.constant(np.array([-1])), axis=0))
        shape = self.add("Concat", one, half, half, six, axis=0)
        rows = [self.add("Reshape", row, shape) for row in self.add("Split", x, outputs=2, axis=2)]
        x = self.add("Concat", *rows, axis=3)
        return str(self.add("Transpose", x, name="pixels", perm=[0, 3, 1, 2]))

    def model(
        self, spec: ModelSpec, inputs: list[Any], outputs: dict[str, tuple[str, Any, list[Any]]]
    ) -> onnx.ModelProto:
        """The finished graph, its outputs under their public names, the spec in its metadata."""
        for public, (tensor, _, _) in outputs.items():
            self.nodes.append(helper.make_node("Identity", [tensor], [public], name=public))
        values = [helper.make_tensor_value_info(public, kind, shape) for public, (_, kind, shape) in outputs.items()]
        graph = helper.make_graph(self.nodes, "psiamfcpp", inputs, values, list(self.constants.values()))
        model = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION, producer_name="psiamfcpp"
        )
        helper.set_model_props(model, {"format": GRAPH_FORMAT, "spec": spec.to_json()})
        return model


def template_graph(spec: ModelSpec, layers: Mapping[str, Layer], ranges: Ranges) -> onnx.ModelProto:
    """The graph ``crop (1, 127, 127, 3) uint8 BGR -> cls_kernel, reg_kernel (1, C, 4, 4)``.

    Args:
        spec: goes into the metadata.
        layers: what `psiamfcpp.export.layers.layers` gives.
        ranges: of what is to be quantized.
    """
    graph = _Graph(layers, ranges)
    x = graph.backbone()
    side = spec.template_size
    outputs = {
        f"{branch}_kernel": (
            graph.conv(f"neck.{branch}_template", x, relu=False),
            TensorProto.FLOAT,
            [1, spec.widths[f"neck.{branch}"], KERNEL, KERNEL],
        )
        for branch in ("cls", "reg")
    }
    crop = helper.make_tensor_value_info("crop", TensorProto.UINT8, [1, side, side, 3])
    return graph.model(spec, [crop], outputs)


def search_graph(spec: ModelSpec, layers: Mapping[str, Layer], ranges: Ranges) -> onnx.ModelProto:
    """The graph ``crop (1, S, S, 3) uint8 BGR, cls_kernel, reg_kernel -> scores (1, N, N), boxes (1, N, N, 4)``.

    Boxes are x0, y0, x1, y1 in pixels of the crop; S is free. Arguments as for `template_graph`.
    """
    graph = _Graph(divided(layers, ranges.factors), ranges)
    cls, reg = _correlation(graph, [spec.widths["neck.cls"], spec.widths["neck.reg"]])
    for i in (1, 2, 3):
        cls = graph.conv(f"head.cls{i}", cls, relu=True)
        reg = graph.conv(f"head.reg{i}", reg, relu=True)
    both = graph.add("Sigmoid", graph.conv("head.scores", cls, relu=False))
    scores = graph.add("ReduceProd", both, axes=[1], keepdims=0)
    boxes = _boxes(graph, scores, graph.conv("head.reg_offsets", reg, relu=False))
    inputs = [helper.make_tensor_value_info("crop", TensorProto.UINT8, [1, "size", "size", 3])]
    for branch in ("cls", "reg"):
        shape = [1, spec.widths[f"neck.{branch}"], KERNEL, KERNEL]
        inputs.append(helper.make_tensor_value_info(f"{branch}_kernel", TensorProto.FLOAT, shape))
    outputs = {
        "scores": (scores, TensorProto.FLOAT, [1, "cells", "cells"]),
        "boxes": (boxes, TensorProto.FLOAT, [1, "cells", "cells", 4]),
    }
    return graph.model(spec, inputs, outputs)


def _correlation(graph: _Graph, widths: list[int]) -> tuple[str, str]:
    """Both depth-wise correlations in one grouped convolution, which is the fastest way in onnxruntime and OpenVINO.

    Its weight is an input, so its groups are fixed and the batch is one: `benchmarks/correlation.py` has the others.
    """
    kernels = graph.add("Concat", "cls_kernel", "reg_kernel", axis=1)
    kernels = graph.add("Reshape", kernels, graph.constant(np.array([-1, 1, KERNEL, KERNEL])))
    split = graph.constant(np.array(widths))
    if graph.ranges.features is not None and graph.ranges.maps is not None:
        maps = _integer_correlation(graph, kernels, graph.ranges.features, graph.ranges.maps)
        cls, reg = graph.add("Split", maps, split, name="branches", outputs=2, axis=1)
        return graph.from_uint8(cls, *_EVEN), graph.from_uint8(reg, *_EVEN)
    features = graph.conv("neck.search", graph.backbone(), relu=False)
    maps = graph.add("Conv", features, kernels, name="correlation", group=sum(widths), kernel_shape=[KERNEL, KERNEL])
    cls, reg = graph.add("Split", maps, split, name="branches", outputs=2, axis=1)
    return cls, reg


def _integer_correlation(graph: _Graph, kernels: str, features: NDArray[np.float32], maps: NDArray[np.float32]) -> str:
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

    x = graph.conv("neck.search", graph.backbone(), relu=False)
    x = graph.from_uint8(graph.to_uint8(x, *_EVEN), *_EVEN)
    x = graph.add("Conv", x, kernels, name="correlation", group=len(maps), kernel_shape=[KERNEL, KERNEL])
    return graph.to_uint8(x, *_EVEN)


def _boxes(graph: _Graph, scores: str, logs: str) -> str:
    """Boxes ``(1, N, N, 4)`` from the logarithms of distances ``(1, 4, N, N)`` in strides."""
    cells = graph.add("Shape", scores, start=1, end=2)
    size = graph.add("Shape", "crop", start=1, end=2)
    one, two, stride = (graph.constant(np.array([v])) for v in (1, 2, STRIDE))
    # first = (size - 1 - (cells - 1) * stride) // 2, as `psiamfcpp.spec.first_cell`
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
    outward = graph.constant(np.array([-STRIDE, -STRIDE, STRIDE, STRIDE], np.float32))
    return graph.add("Add", grid, graph.add("Mul", strides, outward))

"""Graphs built node by node, so that everything is in them: what the graphs of every architecture share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from psiamfcpp.export.layers import Layer
from psiamfcpp.export.rounding import filter_steps, rounded
from psiamfcpp.models import arch
from psiamfcpp.runtime.graph_file import GRAPH_FORMAT
from psiamfcpp.spec import ModelSpec

_OPSET = 17
# IR version of the oldest onnxruntime that the package allows.
_IR_VERSION = 8
# What stands for zero in weights of 8 bits without sign.
_MIDDLE = 128


@dataclass(frozen=True)
class Ranges:
    """The values that 8 bits must hold; by default nothing is quantized."""

    inputs: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """lowest and highest input of each layer that is to be quantized; the other layers stay float"""
    features: NDArray[np.float32] | None = None
    """``(C,)``: largest magnitude of each channel of the features that are correlated"""
    maps: NDArray[np.float32] | None = None
    """``(C,)``: the same of what the correlation makes of these channels"""
    factors: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    """what the output channels of layers are divided by, before the ranges above were taken"""
    rows: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """lowest and highest value of each row's map, in graphs that follow the table row by row"""


@dataclass
class Builder:
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

    def conv(self, name: str, x: str, relu: bool, stride: int = 1, padding: int = 0, groups: int = 1) -> str:
        """The layer of that name, quantized if its input's range is known."""
        layer = self.layers[name]
        if name in self.ranges.inputs:
            x, weight, bias = self._quantized(name, x, layer)
        else:
            weight, bias = self._half(name, layer), self.constant(layer.bias, f"{name}.bias")
        more: dict[str, Any] = {"pads": [padding] * 4} if padding else {}
        if groups > 1:
            more["group"] = groups
        out = self.add("Conv", x, weight, bias, name=name, strides=[stride, stride], **more)
        return self.add("Relu", out, name=f"{name}.relu") if relu else out

    def exact(self, name: str, x: str, bounds: tuple[float, float]) -> str:
        """The layer of that name on a tensor rounded to 8 bits within bounds; its map is float.

        Products are summed in integers, and each sum is scaled once, so every processor gives the same bits. A float
        convolution sums in an order of its own on each.
        """
        layer = self.layers[name]
        folded = layer.weight * layer.gain[:, None, None, None]
        steps = filter_steps(folded).astype(np.float32)
        # With weights without sign the sums are exact on processors that saturate products of unlike signs, too.
        whole = (rounded(folded / steps[:, None, None, None]) + _MIDDLE).astype(np.uint8)
        step, zero = _eight_bits(bounds)
        x = self.to_uint8(x, step, zero)
        weight, zeros = self.constant(whole, f"{name}.weight"), (np.uint8(zero), np.uint8(_MIDDLE))
        sums = self.add("ConvInteger", x, weight, *map(self.constant, zeros), name=f"{name}.sums")
        sums = self.add("Cast", sums, to=TensorProto.FLOAT)
        scale = self.constant((steps * step)[:, None, None], f"{name}.scale")
        bias = self.constant(layer.bias[:, None, None], f"{name}.bias")
        return str(self.add("Add", self.add("Mul", sums, scale), bias, name=name))

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
            x = self.rounded(x, self.ranges.inputs[name])
        folded = layer.weight * layer.gain[:, None, None, None]
        steps = filter_steps(folded)
        # The bias is in 32 bits of the weights' step times the input's: a dead filter's tiny step would cut it off.
        steps = np.maximum(steps, np.abs(layer.bias) / 2**30 / self.steps[x]).astype(np.float32)
        weight = self._in_steps(rounded(folded / steps[:, None, None, None]).astype(np.int8), steps, f"{name}.weight")
        bias_steps = (steps * self.steps[x]).astype(np.float32)
        limit = 2**31 - 1
        # In float64, since float32 rounds the limit up to 2**31, which turns the sign.
        whole = np.rint(layer.bias / bias_steps).astype(np.float64).clip(-limit, limit).astype(np.int32)
        return x, weight, self._in_steps(whole, bias_steps, f"{name}.bias")

    def _in_steps(self, values: NDArray[np.integer], steps: NDArray[np.float32], name: str) -> str:
        """Integers ``(outputs, ...)`` that stand for multiples of a step per output."""
        stored = self.constant(values, name), self.constant(steps, f"{name}_scale")
        zeros = self.constant(np.zeros(len(steps), values.dtype), f"{name}_zero")
        return self.add("DequantizeLinear", *stored, zeros, axis=0)

    def rounded(self, x: str, bounds: tuple[float, float]) -> str:
        """What is left of a tensor after eight bits that hold zero and the bounds."""
        step, zero = _eight_bits(bounds)
        return self.from_uint8(self.to_uint8(x, step, zero), step, zero)

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

    def layer(self, row: arch.Layer, x: str) -> str:
        """The layer of a row of the table, with its pool."""
        return self.pooled(row, self.conv(row.name, x, row.relu, row.stride))

    def pooled(self, row: arch.Layer, x: str) -> str:
        """A layer's map after its pool, if it has one."""
        if row.pool is None:
            return x
        # Pools round up in the network; at the sizes that a spec allows there is nothing to round.
        kernel, stride = ([side, side] for side in row.pool)
        name = f"{row.part}.pool{1 + sum(node.op_type == 'MaxPool' for node in self.nodes)}"
        return str(self.add("MaxPool", x, name=name, kernel_shape=kernel, strides=stride))

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


def _eight_bits(bounds: tuple[float, float]) -> tuple[np.float32, int]:
    """Step and zero of 8 bits that hold zero and the bounds."""
    low, high = min(bounds[0], 0.0), max(bounds[1], 0.0)
    step = np.float32(max((high - low) / 255, 1e-8))
    return step, round(-low / float(step))


def two_by_two(graph: Builder, x: str) -> str:
    """Pixels ``(1, S, S, 3)`` of even S as ``(1, 12, S / 2, S / 2)``, two by two as one."""
    two, six = (graph.constant(np.array([v])) for v in (2, 6))
    one, rest = (graph.constant(np.array([v])) for v in (1, -1))
    half = graph.add("Div", graph.add("Shape", x, start=1, end=2), two)
    x = graph.add("Reshape", x, graph.add("Concat", one, half, two, rest, axis=0))
    shape = graph.add("Concat", one, half, half, six, axis=0)
    rows = [graph.add("Reshape", row, shape) for row in graph.add("Split", x, outputs=2, axis=2)]
    return str(graph.add("Transpose", graph.add("Concat", *rows, axis=3), name="pixels", perm=[0, 3, 1, 2]))

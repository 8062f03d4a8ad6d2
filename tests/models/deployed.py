"""The graphs of a LightFC as its authors deploy it: RGB, normalised, the fusion's branches apart, names of no help."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from psiamfcpp.models.arch import PIXELS, Layer, architecture
from psiamfcpp.models.lightfc import STD, LightFC
from psiamfcpp.spec import ModelSpec

TABLE = architecture("lightfc")
# Filters that are added up where the network has one: of one pixel, and what the map itself counts.
_ONE_PIXEL, _ITSELF = 0.25, 1.0


def random_lightfc(seed: int = 0, widths: dict[str, int] | None = None) -> LightFC:
    """A LightFC, unpruned or of the given widths, with random weights whose signal keeps its strength."""
    network = LightFC(
        ModelSpec(widths or dict(TABLE.groups), 128, 256, calibration=None, architecture="lightfc")
    ).eval()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, value in network.state_dict().items():
            spread = value[0].numel() ** -0.5 if value.ndim == 4 else 0.1
            value.normal_(0, spread, generator=generator)
            if name == "backbone.stem.conv.weight":
                value /= 50
            if name == "fusion.mix.conv.weight":
                # The correlation adds up products of 96 channels.
                value /= 10
    return network


def write_deployed(network: LightFC, folder: Path) -> tuple[Path, Path]:
    """Write both graphs of a network; their files."""
    template, track = folder / "t.onnx", folder / "s.onnx"
    backbone = [row for row in TABLE.layers if row.part == "backbone"]
    _Graph(network, backbone, 128).write(template, {"z": (backbone[-1].name, (1, 96, 8, 8))}, {})
    outputs = {name: (f"clipped.{name}", (1, maps, 16, 16)) for name, maps in (("score", 1), ("size", 2))}
    outputs["offset"] = ("head.offset", (1, 2, 16, 16))
    _Graph(network, list(TABLE.layers), 256).write(track, outputs, {"z": (1, 96, 8, 8)})
    return template, track


class _Graph:
    def __init__(self, network: LightFC, rows: list[Layer], side: int):
        self._state = {name: value.detach().numpy() for name, value in network.state_dict().items()}
        self._nodes: list[Any] = []
        self._constants: list[Any] = []
        self._side = side
        for row in rows:
            getattr(self, f"_{row.operation}")(row)

    def write(self, path: Path, outputs: dict[str, tuple[str, Any]], inputs: dict[str, Any]) -> None:
        for name, (tensor, _) in outputs.items():
            if tensor.startswith("clipped."):
                bounds = (self._constant(np.float32(v)) for v in (1e-4, 1 - 1e-4))
                self._add("Clip", tensor, tensor.replace("clipped", "head"), *bounds)
            self._nodes.append(helper.make_node("Identity", [tensor], [name]))
        shapes = {"image": (1, 3, self._side, self._side), **inputs}
        given = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()]
        made = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, (_, shape) in outputs.items()]
        graph = helper.make_graph(self._nodes, "deployed", given, made, self._constants)
        onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), str(path))

    def _add(self, operator: str, output: str, *inputs: str, **attributes: Any) -> str:
        self._nodes.append(helper.make_node(operator, list(inputs), [output], **attributes))
        return output

    def _constant(self, value: Any) -> str:
        name = f"c{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def _conv(self, row: Layer, output: str, weight: Any, bias: Any, groups: int) -> str:
        read = row.reads[0] if row.reads[0] != PIXELS else "image"
        inputs = read, self._constant(weight), self._constant(bias)
        pads = [weight.shape[2] // 2] * 4
        return self._add("Conv", output, *inputs, pads=pads, strides=[row.stride] * 2, group=groups)

    def _convolution(self, row: Layer, groups: int = 1) -> None:
        weight, bias = (self._state[f"{row.name}.conv.{kind}"] for kind in ("weight", "bias"))
        if row.reads[0] == PIXELS:
            weight = weight[:, ::-1] * np.array(STD[::-1], np.float32)[:, None, None]
        activation = "relu" if row.relu else row.activation
        out = self._conv(row, f"{row.name}.linear" if activation else row.name, weight, bias, groups)
        if activation == "relu6":
            self._add("Clip", row.name, out, *(self._constant(np.float32(v)) for v in (0, 6)))
        elif activation == "gelu":
            half, one, root = (self._constant(np.float32(v)) for v in (0.5, 1, 0.5**0.5))
            erf = self._add("Erf", f"{out}.erf", self._add("Mul", f"{out}.root", out, root))
            halved = self._add("Mul", f"{out}.half", out, half)
            self._add("Mul", row.name, halved, self._add("Add", f"{out}.one", erf, one))
        elif activation:
            self._add(activation.capitalize(), row.name, out)

    def _depthwise(self, row: Layer) -> None:
        channels = len(self._state[f"{row.name}.conv.weight"])
        if row.name != "fusion.mix":
            return self._convolution(row, channels)
        weight, bias = (self._state[f"{row.name}.conv.{kind}"].copy() for kind in ("weight", "bias"))
        weight[..., 1, 1] -= _ONE_PIXEL + _ITSELF
        small = np.full((channels, 1, 1, 1), _ONE_PIXEL, np.float32)
        one = self._conv(row, "one", small, bias / 4, channels)
        three = self._conv(row, "three", weight, bias * 0.75, channels)
        self._add("Add", row.name, self._add("Add", "with_one", row.reads[0], one), three)
        return None

    def _cells(self, row: Layer) -> None:
        cells = self._add("Reshape", "cells", "z", self._constant(np.array([1, 96, 64])))
        features = self._add("Reshape", "flat", row.reads[0], self._constant(np.array([1, 96, 256])))
        product = self._add("MatMul", "product", self._add("Transpose", "turned", cells, perm=[0, 2, 1]), features)
        self._add("Reshape", row.name, product, self._constant(np.array([1, 64, 16, 16])))

    def _sum(self, row: Layer) -> None:
        self._add("Add", row.name, *row.reads)

    def _gate(self, row: Layer) -> None:
        self._add("Mul", row.name, *row.reads)

    def _mean(self, row: Layer) -> None:
        self._add("GlobalAveragePool", row.name, *row.reads)

    def _join(self, row: Layer) -> None:
        self._add("Concat", row.name, *row.reads, axis=1)

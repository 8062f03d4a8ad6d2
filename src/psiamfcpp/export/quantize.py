"""Static quantization: the ranges that 8 bits must cover, measured on crops, and which layers stay float."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto, helper

from psiamfcpp.export.crops import Pair
from psiamfcpp.export.graph import Ranges, search_graph, template_graph
from psiamfcpp.export.layers import Layer
from psiamfcpp.export.parity import Answer, Difference, compare
from psiamfcpp.runtime.onnx_engine import open_session
from psiamfcpp.spec import ModelSpec


def measure(spec: ModelSpec, layers: Mapping[str, Layer], pairs: list[Pair]) -> Ranges:
    """Ranges of the inputs of all layers of the search graph: the lowest and the highest value that any crop gives.

    Nothing is cut off for finer steps: cutting where the squared error of the map is least was tried, and made the
    largest error of the scores larger.

    Args:
        spec: the model's.
        layers: the model's.
        pairs: crops to look at.
    """
    graph = search_graph(spec, layers, Ranges())
    inputs = {n.name: n.input[0] for n in graph.graph.node if n.op_type == "Conv" and n.name != "correlation"}
    tensors = sorted({*inputs.values(), "neck.search", "correlation"})
    graph.graph.output.extend(helper.make_tensor_value_info(t, TensorProto.FLOAT, None) for t in tensors)
    search = open_session(graph.SerializeToString(), None, spec.search_size)
    template = open_session(template_graph(spec, layers, Ranges()).SerializeToString(), None)

    low, high = dict.fromkeys(tensors, 0.0), dict.fromkeys(tensors, 0.0)
    peaks: dict[str, NDArray[np.float32]] = {}
    for pair in pairs:
        cls, reg = template.run(None, {"crop": pair.template[None]})
        feed = {"crop": pair.search[None], "cls_kernel": cls, "reg_kernel": reg}
        for tensor, values in zip(tensors, search.run(tensors, feed), strict=True):
            low[tensor] = min(low[tensor], float(values.min()))
            high[tensor] = max(high[tensor], float(values.max()))
            if tensor in ("neck.search", "correlation"):
                peaks[tensor] = np.maximum(peaks.get(tensor, 0), np.abs(values).max(axis=(0, 2, 3)))
    ranges = {name: (low[tensor], high[tensor]) for name, tensor in inputs.items()}
    # Pixels are whole numbers already.
    ranges["backbone.conv1"] = (0.0, 255.0)
    return Ranges(ranges, peaks["neck.search"], peaks["correlation"])


def without(ranges: Ranges, kept_float: Collection[str]) -> Ranges:
    """The ranges less those of layers that stay float."""
    inputs = {name: bounds for name, bounds in ranges.inputs.items() if name not in kept_float}
    return Ranges(inputs, ranges.features, ranges.maps) if "neck.search" in inputs else Ranges(inputs)


def losses(
    spec: ModelSpec, layers: Mapping[str, Layer], ranges: Ranges, pairs: list[Pair]
) -> Iterator[tuple[str, Difference]]:
    """For each layer in turn: what quantizing it alone changes, against the float graphs.

    Args:
        spec: the model's.
        layers: the model's.
        ranges: what `measure` gives.
        pairs: crops to compare on.
    """
    template = open_session(template_graph(spec, layers, Ranges()).SerializeToString(), None)
    kernels = [template.run(None, {"crop": pair.template[None]}) for pair in pairs]

    def answers(some: Ranges) -> list[Answer]:
        search = open_session(search_graph(spec, layers, some).SerializeToString(), None, spec.search_size)
        found = []
        for pair, (cls, reg) in zip(pairs, kernels, strict=True):
            feed = {"crop": pair.search[None], "cls_kernel": cls, "reg_kernel": reg}
            scores, boxes = search.run(("scores", "boxes"), feed)
            found.append((scores[0], boxes[0]))
        return found

    expected = answers(Ranges())
    for name in ranges.inputs:
        yield name, compare(expected, answers(without(ranges, set(ranges.inputs) - {name})))

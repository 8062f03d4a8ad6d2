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

_BINS = 2048
# One value of so many is counted; no divisor of a map's side, so that all places are.
_STRIDE = 29
# Shares of a range that are tried as the new range: what is cut off against finer steps for the rest.
_SHARES = np.linspace(0.2, 1.0, 81)


def measure(spec: ModelSpec, layers: Mapping[str, Layer], pairs: list[Pair]) -> Ranges:
    """Ranges of the inputs of all layers of the search graph, those that lose least in 8 bits.

    Args:
        spec: the model's.
        layers: the model's.
        pairs: crops to look at.
    """
    graph = search_graph(spec, layers, Ranges())
    inputs = {n.name: n.input[0] for n in graph.graph.node if n.op_type == "Conv" and n.name != "correlation"}
    tensors = sorted({*inputs.values(), "neck.search"})
    graph.graph.output.extend(helper.make_tensor_value_info(t, TensorProto.FLOAT, None) for t in tensors)
    search = open_session(graph.SerializeToString(), None, spec.search_size)
    template = open_session(template_graph(spec, layers, Ranges()).SerializeToString(), None)

    def maps(pair: Pair) -> dict[str, NDArray[np.float32]]:
        cls, reg = template.run(None, {"crop": pair.template[None]})
        feed = {"crop": pair.search[None], "cls_kernel": cls, "reg_kernel": reg}
        return dict(zip(tensors, search.run(tensors, feed), strict=True))

    low, high = dict.fromkeys(tensors, 0.0), dict.fromkeys(tensors, 0.0)
    peaks: NDArray[np.float32] = np.zeros(1, np.float32)
    for pair in pairs:
        for tensor, values in maps(pair).items():
            low[tensor] = min(low[tensor], float(values.min()))
            high[tensor] = max(high[tensor], float(values.max()))
            if tensor == "neck.search":
                peaks = np.maximum(peaks, np.abs(values).max(axis=(0, 2, 3)))
    counts = {tensor: np.zeros(_BINS) for tensor in tensors}
    for pair in pairs:
        for tensor, values in maps(pair).items():
            counts[tensor] += np.histogram(values.ravel()[::_STRIDE], _BINS, (low[tensor], high[tensor]))[0]
    cut = {t: _least_loss(counts[t], low[t], high[t]) for t in tensors}
    ranges = {name: cut[tensor] for name, tensor in inputs.items()}
    # Pixels are whole numbers already.
    ranges["backbone.conv1"] = (0.0, 255.0)
    return Ranges(ranges, peaks)


def _least_loss(counts: NDArray[np.float64], low: float, high: float) -> tuple[float, float]:
    """The part of a range whose quantization to 255 steps has the least squared error."""
    values = low + (np.arange(_BINS) + 0.5) * (high - low) / _BINS
    losses = []
    for share in _SHARES:
        step = share * (high - low) / 255
        beyond = np.maximum(values - share * high, 0) + np.maximum(share * low - values, 0)
        losses.append((counts * np.where(beyond > 0, beyond**2, step**2 / 12)).sum())
    share = float(_SHARES[int(np.argmin(losses))])
    return share * low, share * high


def without(ranges: Ranges, kept_float: Collection[str]) -> Ranges:
    """The ranges less those of layers that stay float."""
    inputs = {name: bounds for name, bounds in ranges.inputs.items() if name not in kept_float}
    return Ranges(inputs, ranges.features if "neck.search" in inputs else None)


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

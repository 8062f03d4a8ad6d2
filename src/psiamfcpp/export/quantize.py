"""Static quantization: the ranges that 8 bits must cover, measured on crops, and which layers stay float."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping

import numpy as np
from onnx import ModelProto, TensorProto, helper
from onnxruntime import InferenceSession

from psiamfcpp.export import equalize
from psiamfcpp.export.crops import Pair
from psiamfcpp.export.graph import Ranges, search_graph, template_graph
from psiamfcpp.export.layers import Float32Array, Layer
from psiamfcpp.export.parity import Answer, Difference, compare
from psiamfcpp.export.rows import may_be_integer
from psiamfcpp.export.rows import tensor as tensor_of
from psiamfcpp.models.arch import PIXELS, opened
from psiamfcpp.runtime.onnx_engine import open_session
from psiamfcpp.spec import ModelSpec


def measure(spec: ModelSpec, layers: Mapping[str, Layer], pairs: list[Pair]) -> Ranges:
    """Ranges of the inputs of all layers of the search graph: the lowest and the highest value that any crop gives.

    Channels are first divided by factors that bring them nearer to each other, since those of a tensor share a range.

    Nothing is cut off for finer steps: cutting where the squared error of the map is least was tried, and made the
    largest error of the scores larger.

    Args:
        spec: the model's.
        layers: the model's.
        pairs: crops to look at.
    """
    if all(row.operation != "correlation" for row in spec.arch.layers):
        return _measure_rows(spec, layers, pairs)
    correlated, correlation = _correlation(spec)
    graph = search_graph(spec, layers, Ranges())
    inputs = {n.name: n.input[0] for n in graph.graph.node if n.op_type == "Conv" and n.name in layers}
    tensors = sorted({*inputs.values(), correlated, correlation})
    low, high = _extremes(spec, layers, graph, tensors, pairs)
    peaks = {tensor: np.maximum(np.abs(low[tensor]), np.abs(high[tensor])) for tensor in tensors}
    searched = {name: next(reader for reader in after if reader in inputs) for name, after in spec.arch.readers.items()}
    factors = {
        name: _factors(peaks[inputs[searched[name]]], layers, after) for name, after in spec.arch.readers.items()
    }
    divisors = {reader: factors[name] for name, reader in searched.items()}
    ranges = {}
    for name, tensor in inputs.items():
        divisor = divisors.get(name, np.float32(1))
        ranges[name] = float((low[tensor] / divisor).min()), float((high[tensor] / divisor).max())
    # Pixels are whole numbers already.
    ranges |= {layer.name: (0.0, 255.0) for layer in spec.arch.layers if layer.reads == (PIXELS,)}
    return Ranges(ranges, peaks[correlated], peaks[correlation], factors)


def _measure_rows(spec: ModelSpec, layers: Mapping[str, Layer], pairs: list[Pair]) -> Ranges:
    """The same for graphs that follow the table row by row.

    In float stay the parts that the exporter names in ``FLOAT``, layers whose map is one cell, since there is nothing
    to gain, the last layers, whose map no integer layer reads, and those before GELU and sigmoid.
    """
    tensors = {row.name: tensor_of(row) for row in spec.arch.layers}
    graph = search_graph(spec, layers, Ranges())
    low, high = _extremes(spec, layers, graph, sorted(tensors.values()), pairs)
    peaks = {name: np.maximum(np.abs(low[tensor]), np.abs(high[tensor])) for name, tensor in tensors.items()}
    factors = equalize.factors(spec.arch, peaks)
    bounds = {}
    for name, tensor in tensors.items():
        factor = factors.get(name, np.float32(1))
        bounds[name] = float((low[tensor] / factor).min()), float((high[tensor] / factor).max())
    kept_float = opened(spec.arch.exporter).FLOAT
    integer = [
        row
        for row in spec.arch.layers
        if may_be_integer(row) and row.part not in kept_float and row not in spec.arch.outputs
        if spec.arch.side(row.name, spec.search_size, spec.template_size) > 1
    ]
    inputs = {row.name: (0.0, 255.0) if row.reads == (PIXELS,) else bounds[row.reads[0]] for row in integer}
    return Ranges(inputs, factors=factors, rows=bounds)


def _extremes(
    spec: ModelSpec, layers: Mapping[str, Layer], graph: ModelProto, tensors: list[str], pairs: list[Pair]
) -> tuple[dict[str, Float32Array], dict[str, Float32Array]]:
    """Lowest and highest value ``(C,)`` of each channel of tensors of a search graph, over all pairs."""
    graph.graph.output.extend(helper.make_tensor_value_info(t, TensorProto.FLOAT, None) for t in tensors)
    search = open_session(graph.SerializeToString(), None, spec.search_size)
    template = open_session(template_graph(spec, layers, Ranges()).SerializeToString(), None)
    low: dict[str, Float32Array] = {}
    high: dict[str, Float32Array] = {}
    for pair in pairs:
        feed = {"crop": pair.search[None], **_kernels(template, pair)}
        for tensor, values in zip(tensors, search.run(tensors, feed), strict=True):
            low[tensor] = np.minimum(low.get(tensor, np.inf), values.min(axis=(0, 2, 3)))
            high[tensor] = np.maximum(high.get(tensor, -np.inf), values.max(axis=(0, 2, 3)))
    return low, high


def _kernels(template: InferenceSession, pair: Pair) -> dict[str, Float32Array]:
    """What the template graph gives for a pair, by name, as the search graph takes it."""
    names = [output.name for output in template.get_outputs()]
    return dict(zip(names, template.run(names, {"crop": pair.template[None]}), strict=True))


def _correlation(spec: ModelSpec) -> tuple[str, str]:
    """Names, in the graphs, of the features that are correlated and of the correlation."""
    row = next(layer for layer in spec.arch.layers if layer.operation == "correlation")
    return spec.arch.exported(row.reads[0]), spec.arch.exported(row.name)


def _factors(peaks: Float32Array, layers: Mapping[str, Layer], after: Collection[str]) -> Float32Array:
    """What to divide channels by so that neither they nor the weights that read them lose much to the largest.

    Half of the way to even channels and half to even weights (SmoothQuant, Xiao et al. 2023, equation 4, alpha 0.5).

    Args:
        peaks: ``(C,)``, largest magnitude of each channel.
        layers: the model's.
        after: those that read the channels.
    """
    folded = [np.abs(layers[name].weight * layers[name].gain[:, None, None, None]) for name in after]
    peak_of_filter = [np.maximum(w.max(axis=(1, 2, 3), keepdims=True), 1e-12) for w in folded]
    shares = np.max([(w / p).max(axis=(0, 2, 3)) for w, p in zip(folded, peak_of_filter, strict=True)], axis=0)
    # A channel that is dead, or that nothing reads, has no say.
    factors: Float32Array = np.sqrt(np.maximum(peaks, max(1e-3 * peaks.max(), 1e-6)) / np.maximum(shares, 1e-3))
    return factors


def without(ranges: Ranges, kept_float: Collection[str]) -> Ranges:
    """The ranges less those of layers that stay float."""
    inputs = {name: bounds for name, bounds in ranges.inputs.items() if name not in kept_float}
    return dataclasses.replace(ranges, inputs=inputs)


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
    kernels = [_kernels(template, pair) for pair in pairs]

    def answers(some: Ranges) -> list[Answer]:
        search = open_session(search_graph(spec, layers, some).SerializeToString(), None, spec.search_size)
        found = []
        for pair, given in zip(pairs, kernels, strict=True):
            scores, boxes = search.run(("scores", "boxes"), {"crop": pair.search[None], **given})
            found.append((scores[0], boxes[0]))
        return found

    expected = answers(Ranges(factors=ranges.factors))
    for name in ranges.inputs:
        yield name, compare(expected, answers(without(ranges, set(ranges.inputs) - {name})))

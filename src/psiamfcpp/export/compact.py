"""Weights of float layers in 8 bits: a smaller file, which computes in float as before."""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, numpy_helper

from psiamfcpp.export.rounding import LARGEST, rounded

# A layer with less than this share of the graph's weights stays in 16 bits: it saves little.
_SMALLEST = 1 / 10
# So does one whose weights differ so much by input channel, as the largest to the median: a filter's step leaves few
# levels to the small ones. In psiamfcpp-alexnet-s three such layers cause more than half of the kernels' error.
_UNEVEN = 4.0


def compact(graph: onnx.ModelProto) -> onnx.ModelProto:
    """Return a graph whose large layers have their 16-bit weights in 8 bits, with a scale per filter.

    `psiamfcpp.export.builder` stores each float weight as ``NAME.weight``, 16 bits, times ``NAME.scale``, a factor per
    filter. The product is computed once, when the graph is loaded, so that speed and operators stay as they are.
    Quantized weights are 8 bits already, and stay.

    Args:
        graph: what an exporter wrote; it is not changed.

    Returns:
        The same nodes, inputs and outputs.
    """
    made = onnx.ModelProto()
    made.CopyFrom(graph)
    stored = {tensor.name: tensor for tensor in made.graph.initializer}
    halves = [t for name, t in stored.items() if t.data_type == TensorProto.FLOAT16 and name.endswith(".weight")]
    total = sum(len(tensor.raw_data) for tensor in halves)
    for tensor in halves:
        weight = numpy_helper.to_array(tensor).astype(np.float32)
        # a filter of zeros must not divide by zero
        step = np.maximum(np.abs(weight).max(axis=(1, 2, 3), keepdims=True), np.float32(1e-30)) / LARGEST
        sizes = np.sqrt(((weight / step) ** 2).mean(axis=(0, 2, 3)))
        if len(tensor.raw_data) >= _SMALLEST * total and sizes.max() < _UNEVEN * np.median(sizes[sizes > 0]):
            scale = stored[f"{tensor.name.removesuffix('.weight')}.scale"]
            tensor.CopyFrom(numpy_helper.from_array(rounded(weight / step).astype(np.int8), tensor.name))
            scale.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(scale) * step, scale.name))
    return made

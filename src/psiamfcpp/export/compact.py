"""Weights of float layers in 8 bits: a smaller file, which computes in float as before."""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, numpy_helper

from psiamfcpp.export.layers import Float32Array

_LARGEST = 127
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
        step = np.maximum(np.abs(weight).max(axis=(1, 2, 3), keepdims=True), np.float32(1e-30)) / _LARGEST
        sizes = np.sqrt(((weight / step) ** 2).mean(axis=(0, 2, 3)))
        if len(tensor.raw_data) >= _SMALLEST * total and sizes.max() < _UNEVEN * np.median(sizes[sizes > 0]):
            scale = stored[f"{tensor.name.removesuffix('.weight')}.scale"]
            tensor.CopyFrom(numpy_helper.from_array(rounded(weight / step).astype(np.int8), tensor.name))
            scale.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(scale) * step, scale.name))
    return made


def rounded(weight: Float32Array) -> Float32Array:
    """Round weights so that the errors of a filter cancel out, per input channel and in all.

    What reads a map of about one value sees the sum of its weights. Rounded to nearest, these sums are off by several
    steps; with few weights rounded the other way, by half a step (SQuant, Guo et al. 2022).

    Args:
        weight: ``(outputs, inputs, k, k)`` in steps, -127 to 127.

    Returns:
        Whole numbers of the same shape, each less than one and a half from its weight.
    """
    flat = weight.reshape(*weight.shape[:2], -1)
    whole = np.rint(flat)
    whole += _turned(flat - whole)
    # Of each input channel the weight that is off most in the direction of the filter's sum may turn too.
    left = flat - whole
    side = np.sign(left.sum(axis=(1, 2)))[:, None, None]
    place = (side * left).argmax(axis=2)[..., None]
    turn = _turned(np.take_along_axis(left, place, axis=2)[..., 0], left.sum(axis=(1, 2)))
    np.put_along_axis(whole, place, np.take_along_axis(whole, place, axis=2) + turn[..., None], axis=2)
    found: Float32Array = whole.clip(-_LARGEST, _LARGEST).reshape(weight.shape)
    return found


def _turned(errors: Float32Array, sums: Float32Array | None = None) -> Float32Array:
    """Return 1 or -1 for the errors ``(..., n)`` to turn, largest first, so that their sum is below a half."""
    sums = errors.sum(axis=-1) if sums is None else sums
    side = np.sign(sums)[..., None]
    place = np.argsort(np.argsort(-side * errors, axis=-1), axis=-1)
    return side * (place < np.abs(np.rint(sums))[..., None])

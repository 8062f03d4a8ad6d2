"""A network's layers as arrays, BatchNorm folded into each convolution."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.models.arch import OPERATIONS, Architecture, opened
from psiamfcpp.models.network import ConvBlock, Network

Float32Array = NDArray[np.float32]


@dataclass(frozen=True)
class Layer:
    """A convolution: ``weight * gain`` and ``bias``."""

    weight: Float32Array
    """``(outputs, inputs, k, k)``, as the checkpoint has it"""
    gain: Float32Array
    """``(outputs,)``: BatchNorm's factor"""
    bias: Float32Array
    """``(outputs,)``, BatchNorm folded in"""


def layers(model: Network) -> dict[str, Layer]:
    """Return the convolutions of both graphs, by the name that they get there.

    Layers that read the same input are one where the table joins them. Every width in between is a multiple of four,
    filled up with filters of zeros: a product of bytes reads four at a time, and widths as pruning leaves them cost
    more than wider ones that are even.
    """
    found: dict[str, Layer] = opened(model.spec.arch.exporter).layers(model)
    return found


def folded(model: Network) -> dict[str, Layer]:
    """Return the network's blocks as they are named in graphs, BatchNorm folded in, joined layers side by side."""
    found: dict[str, Layer] = {}
    for row in model.spec.arch.layers:
        if OPERATIONS[row.operation].weighted:
            block, name = model.get_submodule(row.name), row.joined or row.name
            assert isinstance(block, ConvBlock)
            found[name] = _side_by_side(found[name], _fold(block)) if name in found else _fold(block)
    return found


def divided(
    some: Mapping[str, Layer], factors: Mapping[str, Float32Array], readers: Mapping[str, Iterable[str]]
) -> dict[str, Layer]:
    """Return the same function, with layers' outputs divided by factors ``(C,)`` that their readers multiply by."""
    changed = dict(some)
    for name, factor in factors.items():
        own = changed[name]
        changed[name] = dataclasses.replace(own, gain=own.gain / factor, bias=own.bias / factor)
        for reader in readers[name]:
            weight = changed[reader].weight
            # A depthwise layer has one filter per channel, any other a plane of each filter.
            shape = (-1, 1, 1, 1) if weight.shape[1] == 1 else (-1, 1, 1)
            changed[reader] = dataclasses.replace(changed[reader], weight=weight * factor.reshape(shape))
    return changed


def filled_up(ragged: Mapping[str, Layer], arch: Architecture) -> dict[str, Layer]:
    """Return the same function, every width that another layer reads filled up to a multiple of four."""
    even = dict(ragged)
    for name, after in arch.readers.items():
        own, extra = even[name], -len(even[name].bias) % 4
        even[name] = Layer(
            np.pad(own.weight, [(0, extra), (0, 0), (0, 0), (0, 0)]),
            np.pad(own.gain, (0, extra), constant_values=1),
            np.pad(own.bias, (0, extra)),
        )
        for reader in after:
            weight = np.pad(even[reader].weight, [(0, 0), (0, extra), (0, 0), (0, 0)])
            even[reader] = dataclasses.replace(even[reader], weight=weight)
    return even


def _fold(block: ConvBlock) -> Layer:
    weight = block.conv.weight.detach().double().numpy()
    assert block.conv.bias is not None
    bias = block.conv.bias.detach().double().numpy()
    gain = np.ones(len(weight))
    if block.bn is not None:
        mean, var, scale, shift = (
            t.detach().double().numpy()
            for t in (block.bn.running_mean, block.bn.running_var, block.bn.weight, block.bn.bias)
            if t is not None
        )
        gain = scale / np.sqrt(var + block.bn.eps)
        bias = (bias - mean) * gain + shift
    return Layer(weight.astype(np.float32), gain.astype(np.float32), bias.astype(np.float32))


def _side_by_side(a: Layer, b: Layer) -> Layer:
    return Layer(*(np.concatenate(pair) for pair in ((a.weight, b.weight), (a.gain, b.gain), (a.bias, b.bias))))

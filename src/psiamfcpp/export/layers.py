"""A network's layers as arrays, BatchNorm folded into each convolution."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.models.network import ConvBlock, SiamFCpp

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


def layers(model: SiamFCpp) -> dict[str, Layer]:
    """The convolutions of both graphs, by the name that they get there.

    Layers that read the same input are one: both necks of the search branch (``neck.search``), and class and
    centre-ness (``head.scores``).
    """
    blocks = {name: block for name, block in model.named_modules() if isinstance(block, ConvBlock)}
    folded = {name: _fold(block) for name, block in blocks.items()}
    folded["neck.search"] = _side_by_side(folded.pop("neck.cls_search"), folded.pop("neck.reg_search"))
    folded["head.scores"] = _side_by_side(folded.pop("head.cls_score"), folded.pop("head.centerness"))
    offsets = folded["head.reg_offsets"]
    si, bi = np.float32(model.head.si.item()), np.float32(model.head.bi.item())
    folded["head.reg_offsets"] = Layer(offsets.weight, offsets.gain * si, offsets.bias * si + bi)
    return folded


def aligned(ragged: Mapping[str, Layer]) -> dict[str, Layer]:
    """The same function with every width in between a multiple of four, filled up with filters of zeros.

    A product of bytes reads four at a time: widths as pruning leaves them cost more than wider ones that are even
    (`docs/speed.md`).
    """
    readers = {f"backbone.conv{i}": [f"backbone.conv{i + 1}"] for i in (1, 2, 3, 4)}
    readers["backbone.conv5"] = [name for name in ragged if name.startswith("neck.")]
    for branch, last in (("cls", "scores"), ("reg", "reg_offsets")):
        readers |= {f"head.{branch}1": [f"head.{branch}2"], f"head.{branch}2": [f"head.{branch}3"]}
        readers[f"head.{branch}3"] = [f"head.{last}"]
    even = dict(ragged)
    for name, after in readers.items():
        extra = -len(even[name].bias) % 4
        weight, gain, bias = even[name].weight, even[name].gain, even[name].bias
        even[name] = Layer(
            np.pad(weight, [(0, extra), (0, 0), (0, 0), (0, 0)]),
            np.pad(gain, (0, extra), constant_values=1),
            np.pad(bias, (0, extra)),
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

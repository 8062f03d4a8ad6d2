"""A network's layers as arrays, BatchNorm folded into each convolution."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.models.network import ConvBlock, SiamFCpp

Float32Array = NDArray[np.float32]

_LAST = {"cls": "scores", "reg": "reg_offsets"}


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
    centre-ness (``head.scores``). Every width in between is a multiple of four, filled up with filters of zeros: a
    product of bytes reads four at a time, and widths as pruning leaves them cost more than wider ones that are even.
    """
    blocks = {name: block for name, block in model.named_modules() if isinstance(block, ConvBlock)}
    folded = {name: _fold(block) for name, block in blocks.items()}
    folded["neck.search"] = _side_by_side(folded.pop("neck.cls_search"), folded.pop("neck.reg_search"))
    folded["head.scores"] = _side_by_side(folded.pop("head.cls_score"), folded.pop("head.centerness"))
    offsets = folded["head.reg_offsets"]
    si, bi = np.float32(model.head.si.item()), np.float32(model.head.bi.item())
    folded["head.reg_offsets"] = Layer(offsets.weight, offsets.gain * si, offsets.bias * si + bi)
    return _filled_up(folded)


def readers() -> dict[str, tuple[str, ...]]:
    """For each layer that others read directly or through a pool: those others."""
    chains = [[f"backbone.conv{i}" for i in range(1, 6)]]
    chains += [[f"head.{b}{i}" for i in (1, 2, 3)] + [f"head.{last}"] for b, last in _LAST.items()]
    found = {name: (after,) for chain in chains for name, after in pairwise(chain)}
    return found | {"backbone.conv5": ("neck.search", "neck.cls_template", "neck.reg_template")}


def divided(some: Mapping[str, Layer], factors: Mapping[str, Float32Array]) -> dict[str, Layer]:
    """The same function, with the outputs of layers divided by factors ``(C,)``, which their readers multiply by."""
    changed = dict(some)
    for name, factor in factors.items():
        own = changed[name]
        changed[name] = dataclasses.replace(own, gain=own.gain / factor, bias=own.bias / factor)
        for reader in readers()[name]:
            weight = changed[reader].weight * factor[:, None, None]
            changed[reader] = dataclasses.replace(changed[reader], weight=weight)
    return changed


def _filled_up(ragged: Mapping[str, Layer]) -> dict[str, Layer]:
    even = dict(ragged)
    for name, after in readers().items():
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

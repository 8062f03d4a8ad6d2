"""The table of LightFC (Li et al., Knowledge-Based Systems 2024) as it is deployed: BatchNorm and branches folded.

MobileNetV2 to stride 16, pixel-wise correlation with squeeze-and-excitation, and three heads.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

from psiamfcpp.models.arch import PIXELS, Architecture, Layer

_STEM, _EXPANSION = 32, 6
# Width and stride of each inverted residual behind the first.
_BLOCKS = ((24, 2), (24, 1), (32, 2), (32, 1), (32, 1), *[(64, 2)] + [(64, 1)] * 3, *[(96, 1)] * 3)
# Cells of the template's map of 8x8: what the correlation has as channels.
_CELLS = 64
# Maps of each head, and what follows the last layer: it distinguishes score, size and offset.
HEADS: dict[str, tuple[int, str | None]] = {"score": (1, "sigmoid"), "size": (2, "sigmoid"), "offset": (2, None)}
_HEAD_WIDTHS, _SQUEEZED = (256, 128, 64, 32), 64


def _convolution(
    name: str,
    read: str,
    width: int,
    activation: str | None = None,
    kernel: int = 1,
    group: str | None = None,
    ablation: str | None = None,
) -> Layer:
    """Return a convolution without BatchNorm, padded so that it keeps the side."""
    layer = Layer(name, (read,), width, kernel, bn=False, padding=kernel // 2, group=group, ablation=ablation)
    relu, other = activation == "relu", None if activation == "relu" else activation
    return dataclasses.replace(layer, relu=relu, activation=other)


def _operation(name: str, operation: str, *reads: str, width: int = 0) -> Layer:
    return Layer(name, reads, width, bn=False, relu=False, operation=operation)


def _depthwise(name: str, read: str, stride: int = 1, activation: str | None = None) -> Layer:
    """Return a filter of 3x3 for each channel."""
    return Layer(
        name, (read,), 0, 3, stride, bn=False, padding=1, relu=False, activation=activation, operation="depthwise"
    )


def _backbone() -> Iterator[Layer]:
    """Yield the rows of the backbone; the expanded width of each block is a group."""
    stem = "backbone.stem"
    first = _convolution(stem, PIXELS, _STEM, "relu6", 3, group=stem, ablation=stem)
    yield dataclasses.replace(first, stride=2)
    yield _depthwise("backbone.depthwise0", stem, activation="relu6")
    yield _convolution("backbone.project0", "backbone.depthwise0", 16)
    before, width = "backbone.project0", 16
    for number, (outputs, stride) in enumerate(_BLOCKS, start=1):
        expand, depthwise, project, total = (
            f"backbone.{name}{number}" for name in ("expand", "depthwise", "project", "sum")
        )
        yield _convolution(expand, before, _EXPANSION * width, "relu6", group=expand, ablation=expand)
        yield _depthwise(depthwise, expand, stride, "relu6")
        yield _convolution(project, depthwise, outputs)
        if stride == 1 and outputs == width:
            yield _operation(total, "sum", before, project)
            project = total
        before, width = project, outputs


def _gated(name: str, read: str, width: int, group: str | None = None) -> Iterator[Layer]:
    """Yield the rows of squeeze-and-excitation (Hu et al. 2018); the last one is the gated map."""
    yield _operation(f"{name}_mean", "mean", read)
    yield _convolution(f"{name}_squeeze", f"{name}_mean", _SQUEEZED, "relu")
    yield _convolution(f"{name}_excite", f"{name}_squeeze", width, "sigmoid", group=group)
    yield _operation(f"{name}_gate", "gate", read, f"{name}_excite")


def _fusion(features: str) -> Iterator[Layer]:
    """Yield the rows from the correlation to what the heads read."""
    yield _operation("fusion.correlation", "cells", features, features, width=_CELLS)
    yield from _gated("fusion.correlation", "fusion.correlation", _CELLS)
    yield _depthwise("fusion.mix", "fusion.correlation_gate")
    yield _convolution("fusion.widen", "fusion.mix", 2 * _CELLS, "gelu")
    yield _convolution("fusion.narrow", "fusion.widen", _CELLS)
    yield _operation("fusion.sum", "sum", "fusion.mix", "fusion.narrow")
    yield _convolution("fusion.project", "fusion.sum", 96)
    yield _operation("fusion.join", "join", "fusion.project", features)


def _head(name: str, read: str, maps: int, last: str | None) -> Iterator[Layer]:
    for number, width in enumerate(_HEAD_WIDTHS, start=1):
        row = f"head.{name}{number}"
        yield _convolution(row, read, width, "relu", 3, group=row, ablation=f"head.{number}")
        if number == 1:
            yield from _gated(row, row, width, row)
        read = f"{row}_gate" if number == 1 else row
    yield _convolution(f"head.{name}", read, maps, last)


_FEATURES = tuple(_backbone())
LAYERS = (
    *_FEATURES,
    *_fusion(_FEATURES[-1].name),
    *(row for name, (maps, last) in HEADS.items() for row in _head(name, "fusion.join", maps, last)),
)


def _context(width: float, height: float) -> float:
    """Return the side of the template crop in the frame; named, since loaders in other processes receive it."""
    return 2 * math.sqrt(width * height)


ARCHITECTURE = Architecture(
    layers=LAYERS,
    network="psiamfcpp.models.lightfc:LightFC",
    exporter="psiamfcpp.export.lightfc",
    procedure="psiamfcpp.trackers.lightfc:PROCEDURE",
    objective="psiamfcpp.training.lightfc:OBJECTIVE",
    template_size=128,
    search_size=256,
    sizes=(192, 224, 256),
    stride=16,
    context=_context,
    edge=0.0,
)

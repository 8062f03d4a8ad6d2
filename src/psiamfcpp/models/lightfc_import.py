"""The deployed graphs of LightFC: their weights, found by the order and the shapes of the convolutions, not by name."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from torch import Tensor

from psiamfcpp.errors import UserError
from psiamfcpp.files import read_bytes
from psiamfcpp.models.arch import OPERATIONS, Layer, architecture
from psiamfcpp.models.lightfc import MEAN, STD, LightFC
from psiamfcpp.spec import ModelSpec

_NAME = "lightfc"
# Folded into one here: what is added to a map of the fusion is the map itself and two depthwise convolutions of it.
_BRANCHED = "fusion.mix"
# How far the network may be from the graphs: rounding alone.
_TOLERANCE = 1e-4

Convolution = tuple[Any, NDArray[np.float32], NDArray[np.float32]]
"""attributes, weight and bias"""


def import_lightfc(template: Path, track: Path) -> LightFC:
    """LightFC with the weights of its two deployed graphs.

    Args:
        template: the graph of the template crop: ``image (1, 3, 128, 128) -> z``, RGB, normalised as for ImageNet.
        track: the graph of the search crop: ``image (1, 3, 256, 256), z -> score, size, offset``.

    Returns:
        The network, in evaluation mode. It takes BGR of 0..255; its calibration is open, so that it states nothing.

    Raises:
        UserError: a file cannot be read, or the graphs are not LightFC's, or not of one LightFC.
    """
    table = architecture(_NAME)
    spec = ModelSpec(
        dict(table.groups),
        table.template_size,
        table.search_size,
        calibration=None,
        provenance={"imported_from": f"{template.name}, {track.name}"},
        architecture=_NAME,
    )
    rows = [row for row in table.layers if OPERATIONS[row.operation].weighted]
    backbone = [row for row in rows if row.part == "backbone"]
    weights, again = _matched(track, rows, spec), _matched(template, backbone, spec)
    if any(not torch.equal(weights[name], value) for name, value in again.items()):
        raise UserError(f"{template} and {track} hold different backbones: give the two graphs of one LightFC")
    stem = "backbone.stem.conv.weight"
    weights[stem] = (weights[stem] / torch.tensor(STD[::-1])[:, None, None]).flip(1)
    network = LightFC(spec).eval()
    network.load_state_dict(weights)
    _check(network, template, track)
    return network


def _matched(path: Path, rows: list[Layer], spec: ModelSpec) -> dict[str, Tensor]:
    """The weights of a graph's convolutions, which come in the order of the table, under the table's names."""
    found = iter(_convolutions(path))
    weights: dict[str, Tensor] = {}
    for row in rows:
        attributes, weight, bias = _next(found, path, row)
        if row.name == _BRANCHED:
            # Identity and a filter of one pixel, which is this one, are the middle of the filter of 3x3 beside them.
            middle = 1 + weight[..., 0, 0]
            attributes, weight, other = _next(found, path, row)
            weight, bias = weight.copy(), bias + other
            if weight.shape[2:] == (3, 3):
                weight[..., 1, 1] += middle
        inputs, width = (spec.arch.width(name, spec.widths) for name in (row.reads[0], row.name))
        shape = width, 1 if row.operation == "depthwise" else inputs, row.kernel, row.kernel
        sizes = attributes["strides"][0], attributes["pads"][0]
        if weight.shape != shape or bias.shape != (width,) or sizes != (row.stride, row.padding):
            fault = f"{row.name} is {weight.shape} with stride and padding {sizes}, not {shape}"
            raise UserError(f"{path} is no graph of LightFC: {fault} with {(row.stride, row.padding)}")
        weights[f"{row.name}.conv.weight"] = torch.from_numpy(weight.copy())
        weights[f"{row.name}.conv.bias"] = torch.from_numpy(bias.copy())
    if next(found, None) is not None:
        raise UserError(f"{path} is no graph of LightFC: it has more convolutions than {len(rows)}")
    return weights


def _next(found: Iterator[Convolution], path: Path, row: Layer) -> Convolution:
    convolution = next(found, None)
    if convolution is None:
        raise UserError(f"{path} is no graph of LightFC: it ends before {row.name}")
    return convolution


def _convolutions(path: Path) -> list[Convolution]:
    """Attributes, weights and biases of a graph's convolutions, in float32 and in the order in which they run."""
    content = read_bytes(path, "graph", "give the two graphs of LightFC", 2**30)
    try:
        graph = onnx.load_from_string(content).graph
        values = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    except Exception as error:  # protobuf's errors have no common base of their own
        reason = (str(error) or type(error).__name__).splitlines()[0][:120]
        raise UserError(f"{path} cannot be read as ONNX ({reason})") from None
    found = []
    for node in graph.node:
        if node.op_type == "Cast" and node.input[0] in values:
            values[node.output[0]] = values[node.input[0]]
        if node.op_type != "Conv":
            continue
        if len(node.input) < 3 or not all(name in values for name in node.input[1:]):
            raise UserError(f"{path} is no graph of LightFC: a convolution has no weight or no bias")
        weight, bias = (values[name].astype(np.float32) for name in node.input[1:])
        attributes = {"strides": [1, 1], "pads": [0] * 4} | {a.name: list(a.ints) for a in node.attribute if a.ints}
        found.append((attributes, weight, bias))
    return found


@torch.inference_mode()
def _check(network: LightFC, template: Path, track: Path) -> None:
    """Compare the network with the graphs on crops of noise.

    Raises:
        UserError: they differ by more than rounding.
    """
    generator = torch.Generator().manual_seed(0)
    z, x = (
        torch.randint(256, (1, 3, side, side), generator=generator).float()
        for side in (network.spec.template_size, network.spec.search_size)
    )
    try:
        (features,) = _run(template, {"image": normalised(z)})
        expected = _run(track, {"image": normalised(x), "z": features})
    except Exception as error:  # onnxruntime's errors have no common base of their own
        reason = (str(error) or type(error).__name__).splitlines()[0][:120]
        raise UserError(f"{template} and {track} are no graphs of LightFC ({reason})") from None
    ours = [map_.numpy() for map_ in network.maps(network.features(x), network.template(z))]
    names = ("score", "size", "offset")
    if any(a.shape != b.shape for a, b in zip(ours, expected, strict=True)):
        raise UserError(f"{track} is no graph of LightFC: its outputs are {[b.shape for b in expected]}")
    apart = {name: float(np.abs(a - b).max()) for name, a, b in zip(names, ours, expected, strict=True)}
    if not max(apart.values()) <= _TOLERANCE:
        said = ", ".join(f"{name} by {value:.1g}" for name, value in apart.items())
        raise UserError(f"{track} computes something else than LightFC: {said}")


def normalised(x: Tensor) -> NDArray[np.float32]:
    """Crops ``(B, 3, S, S)``, BGR, 0..255, as the deployed graphs take them: RGB, normalised as for ImageNet."""
    mean, std = (torch.tensor(values)[:, None, None] for values in (MEAN, STD))
    found: NDArray[np.float32] = ((x - mean) / std).flip(1).numpy()
    return found


def _run(path: Path, feed: dict[str, NDArray[np.float32]]) -> list[NDArray[np.float32]]:
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    names = ["z"] if len(feed) == 1 else ["score", "size", "offset"]
    found: list[NDArray[np.float32]] = session.run(names, feed)
    return found

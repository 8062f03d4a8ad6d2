"""Write the graphs that run a model without torch, and check them against it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence as Several
from dataclasses import dataclass, field
from pathlib import Path

from psiamfcpp.datasets import Sequence, read
from psiamfcpp.datasets.choice import HELD_OUT_EVERY, DataChoice
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.ope import mean_over
from psiamfcpp.export.crops import rendered, sample
from psiamfcpp.export.files import Format, write_graphs
from psiamfcpp.export.graph import Ranges
from psiamfcpp.export.layers import layers
from psiamfcpp.export.parity import Difference
from psiamfcpp.export.quantize import losses, measure, without
from psiamfcpp.models import load
from psiamfcpp.trackers import TrackerOptions
from psiamfcpp.trackers.siamfcpp import Tracker
from psiamfcpp.watch import QUIET, Watch


@dataclass(frozen=True)
class Exported:
    """Written graphs, and how far they are from the network."""

    difference: Difference
    """on the crops that are checked"""
    crops: int
    """number of these crops"""
    by_layer: dict[str, Difference] = field(default_factory=dict)
    """what each layer's 8 bits change alone; empty for float graphs"""
    float_layers: list[str] = field(default_factory=list)
    """layers that stay in float although 8 bits were asked for"""
    followed: dict[str, dict[str, float]] = field(default_factory=dict)
    """``precision`` and ``auc`` of ``torch`` and of the ``graphs`` on sequences, where such were given"""
    sequences: int = 0
    """number of these sequences"""
    left_out: list[str] = dataclasses.field(default_factory=list)
    """what of the data could not be read"""


def export(
    model: str | Path,
    output: str | Path,
    *,
    int8: bool = False,
    format: Format = "onnx",
    data: Several[str] = (),
    held_out_every: int = HELD_OUT_EVERY,
    skip_bad: bool = False,
    root: str | Path | None = None,
    pairs: int = 128,
    layer_loss: float = 0.02,
    watch: Watch = QUIET,
) -> Exported:
    """Write the graphs `template` and `search` of a model.

    Args:
        model: name of a shipped checkpoint, or a checkpoint file.
        output: folder for the graphs.
        int8: compute in 8-bit integers; the template graph of LightFC stays float.
        format: onnx, which onnxruntime and OpenVINO read, or OpenVINO's own.
        data: what to calibrate and check on, each LAYOUT:FOLDER as for training; by default rendered clips.
        held_out_every: the N of training: one clip in N is not drawn from; 0 draws from all.
        skip_bad: leave out of the data what cannot be read; `watch` receives what.
        root: folder of sequences to follow with the network in torch and with the graphs, plainly, and compare.
        pairs: targets to calibrate on; a quarter as many others serve the check.
        layer_loss: with ``int8``, layers stay in float whose 8 bits alone cost more than this of the boxes' overlap.
        watch: receives a note on each layer.

    Raises:
        UserError: something cannot be read or written, or the graphs are too far from the network.
    """
    if pairs < 1:
        raise UserError(f"pairs is {pairs}: at least 1 is needed")
    tracks = [] if root is None else read("folder", Path(root))
    network = load(model)
    spec = network.spec
    used, checks = (pairs if int8 else 0), max(4, pairs // 4)
    left_out: list[str] = []
    if data:
        choice = DataChoice(tuple(data), held_out_every, skip_bad)
        choice.note_left_out(watch.note)
        crops, left_out = sample(choice.training, spec, used + checks), choice.left_out
    else:
        watch.note(f"rendering clips for {used + checks} pairs of crops")
        crops = rendered(spec, used + checks)
    ranges, by_layer, kept_float = Ranges(), dict[str, Difference](), list[str]()
    if int8:
        weights = layers(network)
        ranges = measure(spec, weights, crops[:used])
        each = losses(spec, weights, ranges, crops[:checks])
        by_layer = dict(watch.track(each, "layers", len(ranges.inputs)))
        kept_float = [name for name, difference in by_layer.items() if 1 - difference.overlap > layer_loss]
        ranges = without(ranges, kept_float)
        for name, difference in by_layer.items():
            stays = ", stays in float" if name in kept_float else ""
            watch.note(f"{name:18} in 8 bits alone: {difference}{stays}")
    difference = write_graphs(network, Path(output), format, ranges, crops[used:])
    found = Exported(difference, checks, by_layer, kept_float, sequences=len(tracks), left_out=left_out)
    if not tracks:
        return found
    ways = {"torch": (str(model), "torch"), "graphs": (str(output), format)}
    return dataclasses.replace(found, followed={way: _followed(*opened, tracks) for way, opened in ways.items()})


def _followed(model: str, engine: str, sequences: list[Sequence]) -> dict[str, float]:
    """Precision and AUC of a model's plain procedure over the sequences."""
    mean = mean_over(Tracker(model, options=TrackerOptions(engine, plain=True)), sequences)
    return {name: mean.figures[name] for name in ("precision", "auc")}

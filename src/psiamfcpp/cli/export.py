"""`psiamfcpp export`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from psiamfcpp.cli.output import notes, print_json, progress
from psiamfcpp.datasets import Sequence, read, read_entry
from psiamfcpp.errors import UserError


def export(
    model: Annotated[str, tyro.conf.Positional],
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    int8: bool = False,
    format: Literal["onnx", "openvino"] = "onnx",
    data: tuple[str, ...] = (),
    root: Path | None = None,
    pairs: int = 128,
    layer_loss: float = 0.02,
    json: bool = False,
) -> None:
    """Write the graphs that run a model without torch, and check them against it.

    Args:
        model: name of a shipped checkpoint, or a checkpoint file.
        output: folder for the graphs `template` and `search`.
        int8: compute the search graph in 8-bit integers.
        format: onnx, which onnxruntime and OpenVINO read, or OpenVINO's own.
        data: what to calibrate and check on, each LAYOUT:FOLDER as for training; by default rendered clips.
        root: folder of sequences to follow with the network in torch and with the graphs, plainly, and compare.
        pairs: targets to calibrate on; a quarter as many others serve the check.
        layer_loss: with int8, layers stay in float whose 8 bits alone cost more than this of the boxes' overlap.
        json: print one JSON object.
    """
    from psiamfcpp.export.crops import rendered, sample
    from psiamfcpp.export.files import write_graphs
    from psiamfcpp.export.graph import Ranges
    from psiamfcpp.export.layers import layers
    from psiamfcpp.export.quantize import losses, measure, without
    from psiamfcpp.models import load

    if pairs < 1:
        raise UserError(f"pairs is {pairs}: at least 1 is needed")
    tracks = [] if root is None else read("folder", root)
    network = load(model)
    spec = network.spec
    used, checks = (pairs if int8 else 0), max(4, pairs // 4)
    sequences = [sequence for entry in data for sequence in read_entry(entry)]
    crops = sample(sequences, spec, used + checks) if data else rendered(spec, used + checks)
    ranges = Ranges()
    facts: dict[str, Any] = {}
    if int8:
        weights = layers(network)
        with progress() as bar:
            ranges = measure(spec, weights, crops[:used])
            each = losses(spec, weights, ranges, crops[:checks])
            by_layer = dict(bar.track(each, total=len(ranges.inputs), description="layers"))
        kept_float = [name for name, difference in by_layer.items() if 1 - difference.overlap > layer_loss]
        ranges = without(ranges, kept_float)
        facts = {"by_layer": {n: dataclasses.asdict(d) for n, d in by_layer.items()}, "float_layers": kept_float}
        for name, difference in by_layer.items():
            stays = ", stays in float" if name in kept_float else ""
            notes.print(f"{name:18} in 8 bits alone: {_said(difference)}{stays}")
    difference = write_graphs(network, output, format, ranges, crops[used:])
    if tracks:
        facts["followed"] = {
            "torch": _followed(model, "torch", tracks),
            "graphs": _followed(str(output), format, tracks),
        }
    if json:
        print_json({"output": str(output), **dataclasses.asdict(difference), **facts})
        return
    print(f"on {checks} crops, against torch: {_said(difference)}")
    for way, figures in facts.get("followed", {}).items():
        print(f"{way:6} precision {figures['precision']:.3f}, AUC {figures['auc']:.3f} on {len(tracks)} sequences")
    print(f"graphs written to {output}: track with --model {output}")


def _followed(model: str, engine: str, sequences: list[Sequence]) -> dict[str, float]:
    """Precision and AUC of a model's plain procedure over the sequences."""
    from psiamfcpp.evaluation.ope import mean_over
    from psiamfcpp.trackers import TrackerOptions
    from psiamfcpp.trackers.siamfcpp import Tracker

    mean = mean_over(Tracker(model, options=TrackerOptions(engine, plain=True)), sequences)
    return {name: mean.figures[name] for name in ("precision", "auc")}


def _said(difference: Any) -> str:
    return (
        f"scores differ by up to {difference.scores:.1e}, boxes by up to {difference.boxes:.1e} pixels, "
        f"chosen boxes overlap by {difference.overlap:.4f}"
    )

"""`psiamfcpp export`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from psiamfcpp.cli.arguments import HeldOut, Json, Output, Overwrite, SkipBad
from psiamfcpp.cli.output import check_new, print_json, watching
from psiamfcpp.datasets.choice import HELD_OUT_EVERY


def export(
    model: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")],
    output: Output,
    int8: bool = False,
    format: Literal["onnx", "openvino"] = "onnx",
    data: tuple[str, ...] = (),
    held_out_every: HeldOut = HELD_OUT_EVERY,
    root: Path | None = None,
    pairs: int = 128,
    layer_loss: float = 0.02,
    skip_bad: SkipBad = False,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Write the graphs that run a model without torch, and check them against it.

    Args:
        model: name of a shipped checkpoint, or a checkpoint file.
        output: folder for the graphs `template` and `search`.
        int8: compute in 8-bit integers; the template graph of LightFC stays float.
        format: onnx, which onnxruntime and OpenVINO read, or OpenVINO's own.
        data: what to calibrate and check on, each LAYOUT:FOLDER as for training; by default rendered clips.
        root: folder of sequences to follow with the network in torch and with the graphs, plainly, and compare.
        pairs: targets to calibrate on; a quarter as many others serve the check.
        layer_loss: with int8, layers stay in float whose 8 bits alone cost more than this of the boxes' overlap.
    """
    from psiamfcpp.recipes import export as recipe

    check_new([output], overwrite)
    with watching() as watch:
        done = recipe.export(
            model,
            output,
            int8=int8,
            format=format,
            data=data,
            held_out_every=held_out_every,
            skip_bad=skip_bad,
            root=root,
            pairs=pairs,
            layer_loss=layer_loss,
            watch=watch,
        )
    if json:
        facts: dict[str, Any] = {"output": str(output), **dataclasses.asdict(done.difference)}
        if int8:
            by_layer = {name: dataclasses.asdict(difference) for name, difference in done.by_layer.items()}
            facts |= {"by_layer": by_layer, "float_layers": done.float_layers}
        facts |= {"left_out": done.left_out} if skip_bad else {}
        print_json(facts | ({"followed": done.followed} if done.followed else {}))
        return
    print(f"on {done.crops} crops, against torch: {done.difference}")
    for way, figures in done.followed.items():
        figures_said = f"precision {figures['precision']:.3f}, AUC {figures['auc']:.3f}"
        print(f"{way:6} {figures_said} on {done.sequences} sequences")
    print(f"graphs written to {output}: track with --model {output}")

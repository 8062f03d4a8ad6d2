"""`psiamfcpp train`."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from psiamfcpp import __version__, datasets
from psiamfcpp.cli.output import notes
from psiamfcpp.datasets.split import split
from psiamfcpp.training.options import RunOptions, TrainOptions

if TYPE_CHECKING:
    from psiamfcpp.models import SiamFCpp


def train(
    data: tuple[str, ...],
    init: Path,
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    options: TrainOptions = TrainOptions(),  # noqa: B008 - frozen
    run: RunOptions = RunOptions(),  # noqa: B008 - frozen
    held_out_every: int = 10,
    note: str = "",
) -> None:
    """Train a network, or continue the run found in the output folder.

    Under torchrun (`torchrun --nproc-per-node 2 -m psiamfcpp train ...`) each process takes its share of every step.

    Args:
        data: training sets, each LAYOUT:FOLDER (an unknown layout lists the known ones).
        init: start: a checkpoint of ours, a shipped model's name, or torchvision's AlexNet features (.safetensors).
        output: folder of the run: model.safetensors, state.pt, log.jsonl, curve.png.
        options: what decides the result.
        run: how it is carried out.
        held_out_every: one video in so many, chosen by name, is kept out of training to validate with; 0 is none.
        note: a line on the data for the model's provenance.
    """
    import torch

    from psiamfcpp.training.curve import draw_curve
    from psiamfcpp.training.loop import LOG_FILE
    from psiamfcpp.training.loop import train as run_training

    sequences = [s for entry in data for s in datasets.read_entry(entry)]
    training, held_out = split(sequences, held_out_every)
    torch.manual_seed(options.seed)
    model = _start(init, options.seed)
    model.spec = dataclasses.replace(
        model.spec,
        search_size=options.pairs.search_size,
        provenance=_provenance(model.spec.provenance, init, data, options, note),
    )
    first = os.environ.get("RANK", "0") == "0"
    if first:
        notes.print(f"{len(training)} targets to train on, {len(held_out)} clips held out")
    try:
        for row in run_training(model, training, held_out, output, options, run):
            notes.print(_line(row, options.schedule.steps))
    except KeyboardInterrupt:
        notes.print("interrupted; the same command continues from the last saved state")
        raise
    finally:
        if first and (output / LOG_FILE).exists():
            draw_curve(output / LOG_FILE, output / "curve.png")


def _start(init: Path, seed: int) -> SiamFCpp:
    """The network to begin with, from a checkpoint or from ImageNet features."""
    from psiamfcpp.models import SiamFCpp, load
    from psiamfcpp.models.alexnet import init_backbone, is_alexnet
    from psiamfcpp.models.initial import init_neck_and_head
    from psiamfcpp.zoo import weights_path

    path = weights_path(init)
    if not is_alexnet(path):
        return load(path)
    model = SiamFCpp()
    init_backbone(model, path, seed)
    init_neck_and_head(model, seed)
    return model


def _provenance(
    before: dict[str, Any], init: Path, data: tuple[str, ...], options: TrainOptions, note: str
) -> dict[str, Any]:
    """What is known of the model's making: the stages before, and this one."""
    stage = {
        "init": init.name,
        "data": [datasets.named(entry) for entry in data],
        "options": _described(options),
        "version": __version__,
    }
    if note:
        stage["note"] = note
    return {**before, "training": [*before.get("training", []), stage]}


def _described(options: TrainOptions) -> dict[str, Any]:
    """The options; a teacher's file is named without its folder, and not at all where there is none."""
    described = dataclasses.asdict(options)
    teacher = described.pop("teacher")
    if options.teacher.teacher or options.teacher.stored:
        names = {key: Path(teacher[key]).name for key in ("teacher", "stored")}
        described["teacher"] = {**teacher, **names}
    return described


def _line(row: dict[str, Any], steps: int) -> str:
    text = (
        f"step {row['step']}/{steps}  loss {row['total']:.3f} (cls {row['cls']:.3f}, centre {row['centerness']:.3f}, "
    )
    taught = (key for key in ("teacher", "features", "stored") if key in row)
    text += f"iou {row['iou']:.3f}" + "".join(f", {key} {row[key]:.3f}" for key in taught)
    text += f")  {row['pairs_per_s']:.1f} pairs/s"
    if "validation" in row:
        v = row["validation"]
        text += f"  held-out pairs: {v['within8']:.3f} within 8 px, {v['within16']:.3f} within 16, "
        text += f"overlap {v['overlap']:.3f}"
        text += f", separation {v['separation']:.3f}" if v["separation"] is not None else ""
    return text

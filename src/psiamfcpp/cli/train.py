"""`psiamfcpp train`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from psiamfcpp.cli.arguments import Output, SkipBad
from psiamfcpp.cli.output import notes
from psiamfcpp.datasets.choice import HELD_OUT_EVERY
from psiamfcpp.recipes.train import train as run_training
from psiamfcpp.training.options import RunOptions, TrainOptions
from psiamfcpp.watch import Watch


def train(
    data: tuple[str, ...],
    init: Path,
    output: Output,
    options: TrainOptions = TrainOptions(),  # noqa: B008 - frozen
    run: RunOptions = RunOptions(),  # noqa: B008 - frozen
    held_out_every: int = HELD_OUT_EVERY,
    note: str = "",
    skip_bad: SkipBad = False,
) -> None:
    """Train a network, or continue the run found in the output folder.

    Under torchrun (`torchrun --nproc-per-node 2 -m psiamfcpp train ...`) each process takes its share of every step.

    Args:
        data: training sets, each LAYOUT:FOLDER (an unknown layout lists the known ones).
        init: start: a checkpoint of ours, a shipped model's name, or torchvision's AlexNet features (.safetensors).
        output: folder of the run: model.safetensors, state.pt, log.jsonl, curve.png.
        options: what decides the result.
        run: how it is carried out.
        held_out_every: hold out one video in N for validation, chosen by a hash of its name; 0 holds out none.
        note: a line on the data for the model's provenance.
    """
    steps = options.schedule.steps
    try:
        run_training(
            data,
            init,
            output,
            options=options,
            run=run,
            held_out_every=held_out_every,
            note=note,
            skip_bad=skip_bad,
            on_row=lambda row: notes.print(_line(row, steps)),
            watch=Watch(notes.print),
        )
    except KeyboardInterrupt:
        notes.print("interrupted; the same command continues from the last saved state")
        raise


def _line(row: dict[str, Any], steps: int) -> str:
    known = {"cls": "cls", "centerness": "centre", "iou": "iou"} | {k: k for k in ("teacher", "features", "stored")}
    parts = ", ".join(f"{shown} {row[key]:.3f}" for key, shown in known.items() if key in row)
    text = f"step {row['step']}/{steps}  loss {row['total']:.3f} ({parts})  {row['pairs_per_s']:.1f} pairs/s"
    if "validation" in row:
        v = row["validation"]
        text += f"  held-out pairs: {v['within8']:.3f} within 8 px, {v['within16']:.3f} within 16, "
        text += f"overlap {v['overlap']:.3f}"
        text += f", separation {v['separation']:.3f}" if v["separation"] is not None else ""
    return text

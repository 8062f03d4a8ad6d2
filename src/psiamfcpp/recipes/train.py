"""Train a network, or fine-tune one."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psiamfcpp.datasets.choice import HELD_OUT_EVERY, DataChoice
from psiamfcpp.files import check_outputs
from psiamfcpp.training.options import RunOptions, TrainOptions
from psiamfcpp.version import __version__
from psiamfcpp.watch import QUIET, Watch
from psiamfcpp.zoo import weights_path

if TYPE_CHECKING:
    from psiamfcpp.models import Network

_OPTIONS, _RUN = TrainOptions(), RunOptions()


def train(
    data: Sequence[str],
    init: str | Path,
    output: str | Path,
    *,
    options: TrainOptions = _OPTIONS,
    run: RunOptions = _RUN,
    held_out_every: int = HELD_OUT_EVERY,
    note: str = "",
    skip_bad: bool = False,
    on_row: Callable[[dict[str, Any]], None] = lambda row: None,
    watch: Watch = QUIET,
) -> Path:
    """Train a network, or continue the run found in the output folder.

    Args:
        data: training sets, each LAYOUT:FOLDER.
        init: start: a checkpoint of ours, a shipped model's name, or torchvision's AlexNet features (.safetensors).
        output: folder of the run: model.safetensors, state.pt, log.jsonl, curve.png.
        options: what decides the result.
        run: how it is carried out.
        held_out_every: hold out one video in N for validation, chosen by a hash of its name; 0 holds out none.
        note: a line on the data for the model's provenance.
        skip_bad: leave out of the data what cannot be read; `watch` receives what.
        on_row: receives each row of the log as it is written.
        watch: receives one line on the data before the first step.

    Returns:
        The trained checkpoint: the running mean of the weights.

    Raises:
        UserError: data or initial weights cannot be read, or the folder holds a run with other options.
    """
    import torch

    from psiamfcpp.training.curve import draw_curve
    from psiamfcpp.training.loop import LOG_FILE, MODEL_FILE
    from psiamfcpp.training.loop import train as run_training

    init, output, choice = Path(init), Path(output), DataChoice(tuple(data), held_out_every, skip_bad)
    check_outputs([output / MODEL_FILE], [weights_path(init)])
    training, held_out = choice.training, choice.held_out
    torch.manual_seed(options.seed)
    model = _start(init, options.seed)
    model.spec = dataclasses.replace(
        model.spec,
        search_size=options.pairs.search_size,
        provenance=_provenance(model.spec.provenance, init, choice, options, note),
    )
    first = os.environ.get("RANK", "0") == "0"
    if first:
        choice.note_left_out(watch.note)
        usable = sum(len(sequence.usable()) > 0 for sequence in training)
        watch.note(f"{usable} targets to train on, {len(held_out)} clips held out")
    try:
        for row in run_training(model, training, held_out, output, options, run):
            on_row(row)
    finally:
        if first and (output / LOG_FILE).exists():
            draw_curve(output / LOG_FILE, output / "curve.png")
    return output / MODEL_FILE


def _start(init: Path, seed: int) -> Network:
    """The network to begin with, from a checkpoint or from ImageNet features."""
    from psiamfcpp.models import SiamFCpp, load
    from psiamfcpp.models.alexnet import init_backbone, is_alexnet
    from psiamfcpp.models.initial import init_neck_and_head

    path = weights_path(init)
    if not is_alexnet(path):
        return load(path)
    model = SiamFCpp()
    init_backbone(model, path, seed)
    init_neck_and_head(model, seed)
    return model


def _provenance(
    before: dict[str, Any], init: Path, data: DataChoice, options: TrainOptions, note: str
) -> dict[str, Any]:
    """What is known of the model's making: the stages before, and this one."""
    stage = {
        "init": init.name,
        "data": data.named,
        "options": _described(options),
        "version": __version__,
    }
    if note:
        stage["note"] = note
    return {**before, "training": [*before.get("training", []), stage]}


def _described(options: TrainOptions) -> dict[str, Any]:
    """The options; a teacher's files are named without their folder, and not at all where there are none."""
    described = dataclasses.asdict(options)
    teacher = described.pop("teacher")
    if not options.teacher.stored:
        del teacher["stored"], teacher["stored_weight"]
    if options.teacher.teacher or options.teacher.stored:
        names = {key: Path(teacher[key]).name for key in ("teacher", "stored") if key in teacher}
        described["teacher"] = {**teacher, **names}
    return described

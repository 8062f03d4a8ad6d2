"""`psiamfcpp calibrate`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from psiamfcpp import datasets
from psiamfcpp.cli.output import notes, print_json
from psiamfcpp.datasets.split import split
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.calibration import cross_rates, fit, gather
from psiamfcpp.spec import TrackingConstants
from psiamfcpp.trackers.siamfcpp import Tracker


def calibrate(
    model: Annotated[str, tyro.conf.Positional],
    data: Path,
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    constants: TrackingConstants = TrackingConstants(),  # noqa: B008 - frozen
    search_size: int | None = None,
    held_out_every: int = 8,
    half: bool = False,
    json: bool = False,
) -> None:
    """Fit the confidence that parts tracking, unsure and lost, and store it in a copy of the model.

    Args:
        model: name of a shipped model, or a model file.
        data: folder of sequences.
        output: checkpoint to write, .safetensors.
        constants: of the tracking procedure, to calibrate with and to store; the authors' where not given.
        search_size: side of the search crop in pixels, to calibrate with and to store; by default the model's own.
        held_out_every: use only the clips that training with this value kept out; 1 uses all.
        half: store the weights in half precision, for sharing.
        json: print one JSON object.
    """
    import torch

    from psiamfcpp.models import load, save

    clips = split(datasets.read("folder", data), held_out_every)[1]
    if len(clips) < 2:
        raise UserError(f"{data} holds {len(clips)} clips kept out by {held_out_every}: at least two are needed")
    notes.print(f"looking at {len(clips)} clips")
    tracker = Tracker(model, search_size=search_size, plain=True)
    tracker.spec = dataclasses.replace(tracker.spec, constants=constants)
    looks = gather(tracker, clips)
    calibration, rates = fit(looks), cross_rates(looks)
    network = load(model)
    network.spec = dataclasses.replace(
        network.spec,
        search_size=tracker.spec.search_size,
        constants=constants,
        calibration=calibration,
        provenance={**network.spec.provenance, "calibration": dataclasses.asdict(rates)},
    )
    save(output, network, torch.float16 if half else torch.float32)
    if json:
        print_json({"calibration": dataclasses.asdict(calibration), "rates": dataclasses.asdict(rates)})
        return
    print(f"{rates.clips} clips: {rates.found_frames} frames with the target found, {rates.absent_frames} without it")
    print(f"lost limit {calibration.lost_below:.3f}: hits {rates.hit:.3f}, false alarms {rates.false_alarm:.3f}")
    print(f"unsure limit {calibration.unsure_below:.3f}: {rates.unsure:.3f} of the frames with the target found")
    print(
        f"regain limit {calibration.regain_above:.3f}: {rates.regain:.3f} of the frames with the target found, "
        f"{rates.false_regain:.3f} of those without it"
    )

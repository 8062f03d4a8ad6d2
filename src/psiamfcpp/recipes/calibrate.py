"""Fit the confidence that separates tracking, unsure and lost, and store it in a copy of the model."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import torch

from psiamfcpp import datasets
from psiamfcpp.datasets.choice import HELD_OUT_EVERY
from psiamfcpp.datasets.split import split
from psiamfcpp.errors import UserError
from psiamfcpp.files import check_outputs
from psiamfcpp.models import Network, load, save
from psiamfcpp.recipes.calibration import Rates, cross_rates, fit, gather
from psiamfcpp.spec import Calibration, TrackingConstants
from psiamfcpp.trackers.siamfcpp import Tracker
from psiamfcpp.watch import QUIET, Watch


@dataclass(frozen=True)
class Calibrated:
    """A calibrated network."""

    network: Network
    """its spec holds the calibration, and the rates as provenance"""
    calibration: Calibration
    rates: Rates
    """how well the limits do on clips that they were not fitted on"""


def calibrate(
    model: str | Path,
    data: str | Path,
    output: str | Path | None = None,
    *,
    constants: TrackingConstants = TrackingConstants(),  # noqa: B008 - frozen
    search_size: int | None = None,
    held_out_every: int = HELD_OUT_EVERY,
    half: bool = False,
    watch: Watch = QUIET,
) -> Calibrated:
    """Fit the confidence of a model and the limits of its states on clips that it was not trained on.

    Args:
        model: name of a shipped model, or a model file.
        data: folder of sequences.
        output: checkpoint to write, .safetensors.
        constants: of the tracking procedure, to calibrate with and to store; the authors' where not given.
        search_size: side of the search crop in pixels, to calibrate with and to store; by default the model's own.
        held_out_every: use only the clips that training with this value held out; 1 uses all.
        half: store the weights in half precision, for sharing.
        watch: receives the number of clips.

    Raises:
        UserError: fewer than two clips, a model that finds nothing, or a file that cannot be read or written.
    """
    output = None if output is None else Path(output)
    check_outputs([output], [model])
    clips = split(datasets.read("folder", Path(data)), held_out_every)[1]
    if len(clips) < 2:
        raise UserError(f"{data} holds {len(clips)} clips held out by {held_out_every}: at least two are needed")
    watch.note(f"looking at {len(clips)} clips")
    tracker = Tracker(str(model), search_size=search_size, plain=True)
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
    if output:
        save(output, network, torch.float16 if half else torch.float32)
    return Calibrated(network, calibration, rates)

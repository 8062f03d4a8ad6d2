"""`psiamfcpp calibrate`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from psiamfcpp.cli.arguments import Json, Model, Output, Overwrite
from psiamfcpp.cli.output import check_new, print_json, watching
from psiamfcpp.datasets.choice import HELD_OUT_EVERY
from psiamfcpp.spec import TrackingConstants


def calibrate(
    model: Model,
    data: Path,
    output: Output,
    constants: TrackingConstants = TrackingConstants(),  # noqa: B008 - frozen
    search_size: int | None = None,
    held_out_every: int = HELD_OUT_EVERY,
    half: bool = False,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Fit the confidence that separates tracking, unsure and lost, and store it in a copy of the model.

    Args:
        data: folder of sequences.
        output: checkpoint to write, .safetensors.
        constants: of the tracking procedure, to calibrate with and to store; the authors' where not given.
        search_size: side of the search crop in pixels, to calibrate with and to store; by default the model's own.
        held_out_every: use only the clips that training with this value held out; 1 uses all.
        half: store the weights in half precision, for sharing.
    """
    from psiamfcpp.recipes import calibrate as recipe

    check_new([output], overwrite)
    with watching() as watch:
        done = recipe.calibrate(
            model,
            data,
            output,
            constants=constants,
            search_size=search_size,
            held_out_every=held_out_every,
            half=half,
            watch=watch,
        )
    calibration, rates = done.calibration, done.rates
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

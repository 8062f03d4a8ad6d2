"""`psiamfcpp prune`."""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.cli.arguments import HeldOut, Json, Model, Output, Overwrite, SkipBad
from psiamfcpp.cli.output import check_new, print_json, watching
from psiamfcpp.datasets.choice import HELD_OUT_EVERY


def prune(
    model: Model,
    plan: Path,
    output: Output,
    data: tuple[str, ...] = (),
    images: int = 100,
    seed: int = 0,
    held_out_every: HeldOut = HELD_OUT_EVERY,
    skip_bad: SkipBad = False,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Cut a model down to the filters that a plan keeps; fine-tune what comes out with `psiamfcpp train --init`.

    With `--data` what is left is fitted, layer by layer, to give the outputs that it gave before: that takes minutes,
    needs no labels, and gives back most of what the cut has cost. Constants and calibration are kept, but belong to the
    model before: calibrate anew at the end.

    Args:
        plan: file that `psiamfcpp plan` wrote.
        output: checkpoint to write, .safetensors.
        data: sets to draw crops from to fit weights with, each LAYOUT:FOLDER (an unknown layout lists the known ones).
        images: pairs of crops to fit with, drawn as by `psiamfcpp rank`.
        seed: of the draw.
    """
    from psiamfcpp.recipes import prune as recipe

    check_new([output], overwrite)
    with watching() as watch:
        pruned = recipe.prune(
            model,
            plan,
            output,
            data=data,
            images=images,
            seed=seed,
            held_out_every=held_out_every,
            skip_bad=skip_bad,
            watch=watch,
        )
    old, new = pruned.before, pruned.after
    if json:
        print_json({"before": old, "after": new, **({"left_out": pruned.left_out} if skip_bad else {})})
        return
    print(f"parameters  {old['parameters']:,} -> {new['parameters']:,}")
    print(f"search      {old['gmacs']:.2f} -> {new['gmacs']:.2f} GMAC at {pruned.network.spec.search_size} pixels")

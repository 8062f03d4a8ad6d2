"""`psiamfcpp prune`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from psiamfcpp import __version__
from psiamfcpp.cli.output import print_json, progress
from psiamfcpp.datasets.choice import DataChoice
from psiamfcpp.errors import UserError

if TYPE_CHECKING:
    from psiamfcpp.models import SiamFCpp
    from psiamfcpp.pruning.planning import Plan

_BATCH = 8


def prune(
    model: Annotated[str, tyro.conf.Positional],
    plan: Path,
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    data: tuple[str, ...] = (),
    images: int = 100,
    seed: int = 0,
    held_out_every: int = 8,
    json: bool = False,
) -> None:
    """Cut a model down to the filters that a plan keeps; fine-tune what comes out with `psiamfcpp train --init`.

    With `--data` what is left is fitted, layer by layer, to put out what it did before: that takes minutes, wants no
    labels, and gives back most of what the cut has cost. Constants and calibration are kept, but belong to the model
    before: calibrate anew at the end.

    Args:
        model: name of a shipped model, or a model file.
        plan: file that `psiamfcpp plan` wrote.
        output: checkpoint to write, .safetensors.
        data: sets to draw crops from to fit weights with, each LAYOUT:FOLDER (an unknown layout lists the known ones).
        images: pairs of crops to fit with, drawn as by `psiamfcpp rank`.
        seed: of the draw.
        held_out_every: one clip in so many, the same as in `psiamfcpp train`, is kept out of the draw; 0 is none.
        json: print one JSON object.
    """
    from psiamfcpp.models import load, save
    from psiamfcpp.models.cost import count_parameters, search_macs
    from psiamfcpp.pruning.planning import Plan
    from psiamfcpp.pruning.surgery import prune_siamfcpp
    from psiamfcpp.pruning.table import check_groups
    from psiamfcpp.spec import FULL_WIDTHS

    if images < 1:
        raise UserError(f"images is {images}: it must be at least 1")
    if not output.parent.is_dir():
        # said before the minutes that fitting takes
        raise UserError(f"output {output} cannot be written: there is no folder {output.parent}")
    chosen = Plan.read(plan)
    check_groups(chosen.keep, FULL_WIDTHS, f"plan {plan}")
    before = load(model)
    after = prune_siamfcpp(before, chosen)
    step = {"from": Path(model).name, "plan": plan.name, "widths_before": before.spec.widths, "version": __version__}
    if data:
        drawn_from = DataChoice(data, held_out_every)
        after = _refit(after, before, chosen, drawn_from, images, seed)
        step["refit"] = {
            "data": drawn_from.named,
            "images": images,
            "seed": seed,
            "held_out_every": held_out_every,
        }
    provenance = before.spec.provenance
    after.spec = dataclasses.replace(
        after.spec, provenance={**provenance, "pruning": [*provenance.get("pruning", []), step]}
    )
    save(output, after)
    facts: dict[str, Any] = {
        key: {
            "parameters": count_parameters(network),
            "gmacs": search_macs(network.spec.widths, network.spec.search_size) / 1e9,
            "widths": network.spec.widths,
        }
        for key, network in (("before", before), ("after", after))
    }
    if json:
        print_json(facts)
        return
    old, new = facts["before"], facts["after"]
    print(f"parameters  {old['parameters']:,} -> {new['parameters']:,}")
    print(f"search      {old['gmacs']:.2f} -> {new['gmacs']:.2f} GMAC at {before.spec.search_size} pixels")


def _refit(
    after: SiamFCpp,
    before: SiamFCpp,
    plan: Plan,
    data: DataChoice,
    images: int,
    seed: int,
) -> SiamFCpp:
    """The pruned network with weights fitted on so many pairs of crops."""
    from psiamfcpp.pruning.crops import batches, plain_pairs
    from psiamfcpp.pruning.groups import siamfcpp_groups
    from psiamfcpp.pruning.refitting import refit

    pairs = plain_pairs(data.training, before.spec.search_size, seed)
    crops = list(batches(pairs, 0, images, _BATCH))
    with progress() as bar:
        return refit(
            after,
            before,
            plan,
            crops,
            siamfcpp_groups(before.spec.widths),
            lambda layers: bar.track(layers, description="layers"),
        )

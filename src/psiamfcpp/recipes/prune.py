"""Cut a model down to the filters that a plan keeps, and fit what is left."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from psiamfcpp.datasets.choice import HELD_OUT_EVERY, DataChoice
from psiamfcpp.errors import UserError
from psiamfcpp.files import check_outputs
from psiamfcpp.models import Network, load, save
from psiamfcpp.models.cost import facts
from psiamfcpp.pruning.models import groups_of, prune_model
from psiamfcpp.pruning.planning import Plan
from psiamfcpp.pruning.refitting import refit
from psiamfcpp.pruning.table import check_groups
from psiamfcpp.recipes.fit_crops import batches, plain_pairs
from psiamfcpp.version import __version__
from psiamfcpp.watch import QUIET, Watch

_BATCH = 8


@dataclass(frozen=True)
class Pruned:
    """A pruned network and what it saves."""

    network: Network
    """its spec says from which model and by which plan it was made"""
    before: dict[str, Any]
    """``parameters``, ``gmacs`` and ``widths`` of the model before"""
    after: dict[str, Any]
    """the same of the pruned network"""
    left_out: list[str] = dataclasses.field(default_factory=list)
    """what of the data could not be read"""


def prune(
    model: str | Path,
    plan: str | Path | Plan,
    output: str | Path | None = None,
    *,
    data: Sequence[str] = (),
    images: int = 100,
    seed: int = 0,
    held_out_every: int = HELD_OUT_EVERY,
    skip_bad: bool = False,
    watch: Watch = QUIET,
) -> Pruned:
    """Cut a model down to the filters that a plan keeps; fine-tune what comes out.

    With data what is left is fitted, layer by layer, to give the outputs that it gave before (see
    `psiamfcpp.pruning.refit`). Constants and calibration are kept, but belong to the model before.

    Args:
        model: name of a shipped model, or a model file.
        plan: a plan of all groups, or the file of one.
        output: checkpoint to write, .safetensors.
        data: sets to draw crops from to fit weights with, each LAYOUT:FOLDER.
        images: pairs of crops to fit with, drawn as by `psiamfcpp.recipes.rank.rank`.
        seed: of the draw.
        held_out_every: the N of training: one clip in N is not drawn from; 0 draws from all.
        skip_bad: leave out of the data what cannot be read; `watch` receives what.
        watch: receives progress.

    Raises:
        UserError: a file cannot be read or written, the plan is for another model, or the data hold nothing to draw.
    """
    plan = Path(plan) if isinstance(plan, str) else plan
    output = None if output is None else Path(output)
    check_outputs([output], [model, plan if isinstance(plan, Path) else None])
    if images < 1:
        raise UserError(f"images is {images}: it must be at least 1")
    if output and not output.parent.is_dir():
        # said before the minutes that fitting takes
        raise UserError(f"output {output} cannot be written: there is no folder {output.parent}")
    chosen = Plan.read(plan) if isinstance(plan, Path) else plan
    before = load(model)
    check_groups(chosen.keep, before.spec.arch.groups, f"plan {plan}" if isinstance(plan, Path) else "the plan")
    after = prune_model(before, chosen)
    step: dict[str, Any] = {
        "from": Path(model).name,
        "plan": plan.name if isinstance(plan, Path) else None,
        "widths_before": before.spec.widths,
        "version": __version__,
    }
    left_out: list[str] = []
    if data:
        choice = DataChoice(tuple(data), held_out_every, skip_bad)
        choice.note_left_out(watch.note)
        left_out = choice.left_out
        pairs = plain_pairs(choice.training, before.spec, seed)
        crops, groups = list(batches(pairs, 0, images, _BATCH)), groups_of(before.spec)
        after = refit(after, before, chosen, crops, groups, lambda names: watch.track(names, "layers"))
        step["refit"] = {"data": choice.named, "images": images, "seed": seed, "held_out_every": held_out_every}
    provenance = before.spec.provenance
    after.spec = dataclasses.replace(
        after.spec, provenance={**provenance, "pruning": [*provenance.get("pruning", []), step]}
    )
    if output:
        save(output, after)
    return Pruned(after, facts(before.spec), facts(after.spec), left_out)

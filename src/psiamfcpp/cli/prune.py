"""`psiamfcpp prune`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro

from psiamfcpp import __version__
from psiamfcpp.cli.output import print_json


def prune(
    model: Annotated[str, tyro.conf.Positional],
    plan: Path,
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    json: bool = False,
) -> None:
    """Cut a model down to the filters that a plan keeps; fine-tune what comes out with `psiamfcpp train --init`.

    Constants and calibration are kept, but belong to the model before: calibrate anew after fine-tuning.

    Args:
        model: name of a shipped model, or a model file.
        plan: file that `psiamfcpp plan` wrote.
        output: checkpoint to write, .safetensors.
        json: print one JSON object.
    """
    from psiamfcpp.models import load, save
    from psiamfcpp.models.cost import count_parameters, search_macs
    from psiamfcpp.pruning.planning import Plan
    from psiamfcpp.pruning.surgery import prune_siamfcpp
    from psiamfcpp.pruning.table import check_groups
    from psiamfcpp.spec import FULL_WIDTHS

    chosen = Plan.read(plan)
    check_groups(chosen.keep, FULL_WIDTHS, f"plan {plan}")
    before = load(model)
    after = prune_siamfcpp(before, chosen)
    step = {"from": Path(model).name, "plan": plan.name, "widths_before": before.spec.widths, "version": __version__}
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

"""`psiamfcpp info`."""

from __future__ import annotations

import dataclasses
from typing import Any

from psiamfcpp.cli.arguments import Json, Model
from psiamfcpp.cli.output import print_json
from psiamfcpp.files import printable
from psiamfcpp.runtime import open_engine
from psiamfcpp.spec import ModelSpec
from psiamfcpp.zoo import graph_folder, names


def info(model: Model, json: Json = False) -> None:
    """Describe a model: a checkpoint, or a folder of graphs."""
    from psiamfcpp.models.cost import facts as cost

    spec = _spec(model)
    facts: dict[str, Any] = {
        "architecture": spec.architecture,
        **cost(spec),
        "search_size": spec.search_size,
        "constants": dataclasses.asdict(spec.constants),
        "calibration": dataclasses.asdict(spec.calibration) if spec.calibration else None,
        "provenance": spec.provenance,
    }
    if json:
        print_json(facts)
        return
    print(f"architecture {facts['architecture']}")
    print(f"parameters   {facts['parameters']:,}")
    print(f"search       {facts['gmacs']:.2f} GMAC at {spec.search_size} pixels")
    print("widths       " + ", ".join(f"{name} {width}" for name, width in spec.widths.items()))
    for title in ("constants", "calibration", "provenance"):
        said = ", ".join(f"{key} {value}" for key, value in (facts[title] or {}).items())
        # what a file says of itself may be anything
        print(f"{title:12} {printable(said) or 'none'}")


def _spec(model: str) -> ModelSpec:
    from psiamfcpp.models import load

    if model not in names() and graph_folder(model):
        return open_engine(model, threads=1).spec
    return load(model).spec

"""`psiamfcpp info`."""

from __future__ import annotations

from typing import Annotated

import tyro

from psiamfcpp.cli.arguments import Json
from psiamfcpp.cli.output import print_json
from psiamfcpp.files import printable
from psiamfcpp.recipes.info import info as describe

Described = Annotated[
    str,
    tyro.conf.Positional,
    tyro.conf.arg(
        metavar="MODEL", help="a shipped model, a model file, a folder of graphs, or any other tracker, as opencv:mil"
    ),
]


def info(model: Described, json: Json = False) -> None:
    """Describe a model or another tracker: what `psiamfcpp track` takes as --model or --tracker."""
    facts = describe(model)
    if json:
        print_json(facts)
        return
    if "kind" in facts:
        for key, value in facts.items():
            print(f"{key:12} {printable(str(value)) or 'none'}")
        return
    print(f"architecture {facts['architecture']}")
    print(f"parameters   {facts['parameters']:,}")
    print(f"search       {facts['gmacs']:.2f} GMAC at {facts['search_size']} pixels")
    print("widths       " + ", ".join(f"{name} {width}" for name, width in facts["widths"].items()))
    for title in ("constants", "calibration", "provenance"):
        said = ", ".join(f"{key} {value}" for key, value in (facts[title] or {}).items())
        # what a file says of itself may be anything
        print(f"{title:12} {printable(said) or 'none'}")

"""`psiamfcpp info`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

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

# What distinguishes a step of pruning or training from the others; `--json` has the rest.
_MAIN_FACTS = (
    *("from", "init", "plan", "data", "images", "batch", "steps", "stopped_after_steps", "lr", "search_size"),
    *("stored", "teacher", "version"),
)


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
    for title in ("constants", "calibration"):
        print(f"{title:12} {_text(facts[title]) or 'none'}")
    lines = list(_provenance(facts["provenance"])) or ["none"]
    for number, line in enumerate(lines):
        print(f"{'' if number else 'provenance':12} {line}")


def _provenance(given: dict[str, Any]) -> Iterator[str]:
    """Give a line per fact, and one per step of those that were made in steps.

    What a file says of itself may be anything.
    """
    for name, value in given.items():
        if not isinstance(value, list):
            yield printable(f"{name} {_text(value)}")
            continue
        for number, step in enumerate(value, 1):
            found = dict(_leaves(step)) if isinstance(step, dict) else {}
            main = {fact: found[fact] for fact in _MAIN_FACTS if found.get(fact)}
            yield printable(f"{name} {number}: {_text(main) or _text(step)}")


def _leaves(tree: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _leaves(value)
        else:
            yield name, value


def _text(value: Any) -> str:
    """Return a value in a line."""
    match value:
        case None:
            return ""
        case float():
            return f"{value:.4g}"
        case dict():
            return ", ".join(f"{name} {_text(part)}" for name, part in value.items())
        case list() | tuple():
            return " ".join(map(_text, value))
        case _:
            return str(value)

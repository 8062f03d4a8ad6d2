"""`psiamfcpp trackers`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro

from psiamfcpp.cli.arguments import Json
from psiamfcpp.cli.output import print_json
from psiamfcpp.errors import UserError
from psiamfcpp.trackers.listing import Listed, list_trackers
from psiamfcpp.trackers.trax.adapter import adapters


def trackers(
    adapter: tyro.conf.UseAppendAction[list[str]],
    json: Json = False,
) -> None:
    """List the trackers that other commands can open, how to write them, and what is missing for each.

    Args:
        adapter: look for the files of an adapter, as transt,checkout=DIR,weights=FILE,python=PY; may be repeated.
    """
    rows = list_trackers(dict(_adapter(text) for text in adapter))
    if json:
        print_json({"trackers": [dataclasses.asdict(row) for row in rows]})
        return
    for row in rows:
        print(f"{row.kind:9}  {row.name:24}  {row.write}")
        for line in _details(row):
            print(f"{'':9}  {line}")


def _details(row: Listed) -> list[str]:
    facts = row.facts
    about = [f"{facts['repository']} at {facts['commit'][:10]}, licence: {facts['licence']}"] if facts else []
    return about + [f"missing {what}" for what in row.missing]


def _adapter(text: str) -> tuple[str, dict[str, str]]:
    name, *pairs = text.removeprefix("adapter:").split(",")
    if name not in adapters():
        raise UserError(f"unknown adapter {name!r}: there are {', '.join(adapters())}")
    options = {}
    for pair in pairs:
        key, sign, value = pair.partition("=")
        if not sign:
            raise UserError(f"adapter {text!r}: {pair!r} is not KEY=VALUE")
        if key in ("checkout", "weights") and not Path(value).exists():
            raise UserError(f"{key} {value} of adapter:{name} does not exist")
        options[key] = value
    return name, options

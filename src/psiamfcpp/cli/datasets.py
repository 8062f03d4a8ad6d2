"""`psiamfcpp datasets`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from psiamfcpp.cli.arguments import Json
from psiamfcpp.cli.output import print_json
from psiamfcpp.datasets import BENCHMARKS
from psiamfcpp.errors import UserError
from psiamfcpp.recipes.find import find_benchmark


def datasets(root: Path | None = None, json: Json = False) -> None:
    """List the benchmarks, where to get them, and what of them is there.

    Args:
        root: folder to look into: one that holds the benchmarks' folders, or a benchmark's own.
    """
    if root is not None and not root.is_dir():
        raise UserError(f"folder {root} does not exist")
    rows: list[dict[str, Any]] = [
        {
            "name": benchmark.name,
            "size": benchmark.size,
            "source": benchmark.source,
            "layout": benchmark.layout,
            "found": found and dataclasses.asdict(found),
        }
        for benchmark in BENCHMARKS.values()
        for found in [None if root is None else find_benchmark(benchmark, root)]
    ]
    if json:
        print_json({"datasets": rows})
        return
    for row in rows:
        size = "" if row["size"] is None else f", {row['size']} sequences"
        print(f"{row['name']:13} {row['source']}{size}")
        print(f"{'':13} {row['layout']}")
        if root is not None:
            print(f"{'':13} {_describe(row['found'])}")


def _describe(found: dict[str, Any] | None) -> str:
    if found is None:
        return "not found"
    what = f"{found['sequences']} sequences, {found['labels']} labels, {found['frames']} frames in {found['root']}"
    if found["problem"] is None:
        return f"found {what}"
    return f"found {what}, but {found['problem']}" if found["sequences"] else f"not found: {found['problem']}"

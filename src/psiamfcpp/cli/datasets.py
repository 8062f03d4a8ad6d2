"""`psiamfcpp datasets`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from psiamfcpp.cli.arguments import Json
from psiamfcpp.cli.output import print_json
from psiamfcpp.datasets import BENCHMARKS, Benchmark
from psiamfcpp.errors import UserError


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
            "found": None if root is None else _find(benchmark, root),
        }
        for benchmark in BENCHMARKS.values()
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


def _find(benchmark: Benchmark, root: Path) -> dict[str, Any] | None:
    """What of a benchmark is in a folder of its name, or in the root itself; None if that is nothing."""
    folders = [root, *sorted(path for path in root.iterdir() if path.is_dir())]
    named = [path for path in folders if benchmark.owns(path if path.name else path.resolve())]
    place = named[0] if named else root
    found: dict[str, Any] = {"root": str(place), "sequences": 0, "labels": 0, "frames": 0, "problem": None}
    try:
        # A plain folder of labels could be anybody's: its name must tell.
        if not named and not benchmark.label_files(place):
            return None
        labels = benchmark.read_labels(place)
        found |= {"sequences": len(labels), "labels": sum(map(len, labels.values()))}
        found["frames"] = sum(map(len, benchmark.read(place)))
    except UserError as error:
        found["problem"] = str(error)
    return found


def _describe(found: dict[str, Any] | None) -> str:
    if found is None:
        return "not found"
    what = f"{found['sequences']} sequences, {found['labels']} labels, {found['frames']} frames in {found['root']}"
    if found["problem"] is None:
        return f"found {what}"
    return f"found {what}, but {found['problem']}" if found["sequences"] else f"not found: {found['problem']}"

"""A list of all trackers that can be opened, with what is missing for each."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from psiamfcpp.trackers.nanotrack import VERSIONS
from psiamfcpp.trackers.opencv import FILES, opencv_trackers
from psiamfcpp.trackers.trax.adapter import describe_adapters
from psiamfcpp.zoo import graph_names, names


@dataclass(frozen=True)
class Listed:
    """One tracker."""

    kind: str
    """model, dcf, opencv, nanotrack, adapter, trax or module"""
    name: str
    write: str
    """how it is given to a command, with capitals for what the user fills in"""
    missing: list[str] = field(default_factory=list)
    """what to install or fetch; empty where it can run now"""
    facts: dict[str, Any] = field(default_factory=dict)
    """of an adapter: repository, commit, licence, modules, colour order, where pixels are counted from"""


def list_trackers(adapters: Mapping[str, Mapping[str, str]] | None = None) -> list[Listed]:
    """Return all trackers, by kind.

    Args:
        adapters: checkout, weights and python by adapter, as far as they are known.
    """
    rows = [Listed("model", name, name) for name in sorted({*graph_names(), *names()})]
    rows += _filters()
    rows += [_opencv(name) for name in opencv_trackers()]
    rows += [
        Listed("nanotrack", f"NanoTrack {version}", f"nanotrack:{version},backbone=FILE.onnx,head=FILE.onnx",
               ["files: backbone and head of github.com/HonglinChu/SiamTrackers (Apache-2.0)"])
        for version in VERSIONS
    ]  # fmt: skip
    for row in describe_adapters(adapters):
        name, missing = row.pop("adapter"), row.pop("missing")
        write = f"adapter:{name},checkout=DIR,weights=FILE,python=PY[,device=cuda]"
        rows.append(Listed("adapter", row["name"], write, missing, row))
    rows.append(Listed("trax", "any TraX program", "trax:COMMAND"))
    rows.append(Listed("module", "any Python class", "MODULE:CLASS"))
    return rows


def _opencv(full_name: str) -> Listed:
    """Return the row of one of OpenCV's trackers."""
    short, files = full_name.removeprefix("Tracker").lower(), FILES.get(full_name, ())
    write = f"opencv:{short}" + "".join(f",{part}=FILE.onnx" for part in files)
    return Listed(
        "opencv", full_name, write, ["files: networks of opencv/opencv_zoo or their authors"] if files else []
    )


def _filters() -> list[Listed]:
    """Return the correlation filters, where this package has them."""
    if importlib.util.find_spec("psiamfcpp.trackers.dcf") is None:
        return []
    filters = importlib.import_module("psiamfcpp.trackers.dcf").FILTERS
    absent = [name for name in ("numba", "scipy") if importlib.util.find_spec(name) is None]
    missing = ["modules: " + ", ".join(absent) + " (pip install 'psiamfcpp[dcf]')"] if absent else []
    return [Listed("dcf", name, f"dcf:{name}", list(missing)) for name in filters]

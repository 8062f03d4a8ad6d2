"""Figures that the paper printed (Wang et al., ICME 2022), transcribed from its tables; none was measured here.

Its text gives 46.6 frames a second in one place where the tables give 46.1: the tables stand. Trackers are spelled as
their own papers do (the table has PrDimp18 and LightTrank).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from psiamfcpp.evaluation.metrics import Convention

_FILE = Path(__file__).with_name("published.json")


@dataclass(frozen=True)
class Published:
    """One tracker on one benchmark; None where the table does not say."""

    tracker: str
    dataset: str
    """name of the benchmark, or ``average`` over those of `averaged`"""
    precision: float
    """share of frames with a centre error of at most 20 pixels, as printed"""
    source: str
    """the table, with its label in the paper's source"""
    fps_cpu: float | None = None
    fps_gpu: float | None = None
    parameters: int | None = None
    convention: Convention | None = None
    """that its precision follows (docs/evaluation.md); the paper does not say, and for some trackers nobody does"""


@dataclass(frozen=True)
class PrunedLayer:
    """Precision of P-SiamFC++ with one layer, or all, pruned to several degrees."""

    layer: str
    """the table's name of it: ``L1 (Backbone)`` ... ``Backbone + Neck + Head``"""
    dataset: str
    precision: dict[float, float]
    """by the ratio that the table prints"""
    source: str


def published() -> list[Published]:
    """Every row of the paper's tables of trackers, in its order."""
    return [Published(**row) for row in _read()["rows"]]


def averaged() -> list[str]:
    """The benchmarks that the paper averages over."""
    return list(_read()["average"])


def pruned_layers() -> list[PrunedLayer]:
    """Every row of the paper's table of pruning ratios, in its order."""
    table = _read()["pruning_ratios"]
    return [
        PrunedLayer(layer, table["dataset"], dict(zip(table["ratios"], row, strict=True)), table["source"])
        for layer, row in table["precision"].items()
    ]


def gains() -> dict[str, dict[str, float]]:
    """Return by how much P-SiamFC++ is stated to exceed RACF: ``precision`` and ``auc`` by benchmark (Section 4.2)."""
    return {figure: dict(_read()["gains"][figure]) for figure in ("precision", "auc")}


def _read() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(_FILE.read_text())
    return found

"""Table 4 of the paper: SiamFC++ with one layer, or all, pruned to each ratio (section 4.5)."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from psiamfcpp.models.arch import DEFAULT, architecture
from psiamfcpp.report.published import pruned_layers
from psiamfcpp.watch import Watch

if TYPE_CHECKING:
    from psiamfcpp.recipes.sensitivity import Cell


def run_ratios(
    model: str, root: Path, folder: Path, ranks: Path | None, data: Sequence[str], steps: int, jobs: int, watch: Watch
) -> None:
    """Measure the networks of Table 4 that are not measured yet.

    Args:
        model: the unpruned network.
        root: DTB70.
        folder: where each network leaves its figures.
        ranks: rank table of the model; without it, one is made from ``data`` beside the folder.
        data: training sets; without them nothing is fine-tuned.
        steps: budget of fine-tuning of each network.
        jobs: networks that are measured side by side.
        watch: receives progress.

    Raises:
        UserError: a file cannot be read, or the folder holds networks of another setup.
    """
    from psiamfcpp.recipes.rank import rank
    from psiamfcpp.recipes.sensitivity import Setup, measure_all
    from psiamfcpp.training.options import SHORT

    if ranks is None:
        ranks = folder.parent / "ranks.json"
        folder.parent.mkdir(parents=True, exist_ok=True)
        rank(model, data, ranks, watch=watch)
    options = dataclasses.replace(SHORT, schedule=dataclasses.replace(SHORT.schedule, steps=steps))
    wanted = _cells(bool(data))
    done = measure_all(Setup(model, ranks, root, tuple(data), options), wanted, folder, jobs)
    for _ in watch.track(done, "networks of Table 4", len(wanted)):
        pass


def ratios_left(folder: Path | None, tuned: bool) -> int:
    """Return how many networks of Table 4 are not measured yet."""
    return sum(folder is None or not (folder / f"{cell.name}.json").is_file() for cell in _cells(tuned))


def read_ratios(folder: Path) -> tuple[list[dict[str, object]], int]:
    """Return the networks of Table 4 that are measured, with the paper's name of their layer, and the budget."""
    if not (folder / "setup.json").is_file():
        return [], 0
    names = dict(zip(_rows(), (layer.layer for layer in pruned_layers()), strict=True))
    cells = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json")) if path.name != "setup.json"]
    budget = json.loads((folder / "setup.json").read_text())["options"]["schedule"]["steps"]
    return [{**cell, "layer": names[cell["row"]]} for cell in cells if cell.get("row") in names], budget


def _cells(with_tuning: bool) -> list[Cell]:
    from psiamfcpp.recipes.sensitivity import Cell

    ratios = list(pruned_layers()[0].precision)
    stages = (False, True) if with_tuning else (False,)
    return [Cell(row, ratio, tuned=tuned) for tuned in stages for row in _rows() for ratio in ratios]


def _rows() -> list[str]:
    """Return the rows of Table 4 as the package calls them, in the paper's order."""
    return list(architecture(DEFAULT).ablation)

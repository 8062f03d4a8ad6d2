"""What pruning costs: the paper's table of ratios (section 4.5), and criteria compared on one plan.

The only part of pruning that trains and tracks.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from psiamfcpp import datasets
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.ope import mean_over
from psiamfcpp.models import SiamFCpp, load, save
from psiamfcpp.models.cost import count_parameters, search_macs
from psiamfcpp.pruning.criteria import CRITERIA, keep_best, scores
from psiamfcpp.pruning.groups import siamfcpp_groups
from psiamfcpp.pruning.planning import PAPER_KEEP, Plan, choose, kept_count, plan
from psiamfcpp.pruning.surgery import prune_siamfcpp
from psiamfcpp.pruning.table import RankTable, read_json, write_json
from psiamfcpp.spec import FULL_WIDTHS, TEMPLATE_SIZE
from psiamfcpp.trackers import TrackerOptions
from psiamfcpp.trackers.siamfcpp import Tracker
from psiamfcpp.training.loop import MODEL_FILE, PairLoss, train
from psiamfcpp.training.options import RunOptions, TrainOptions
from psiamfcpp.training.validation import held_out_batches
from psiamfcpp.zoo import weights_path

# The paper's nine rows: one layer alone, a head layer of both branches, and every layer at once.
ROWS: dict[str, tuple[str, ...]] = {
    **{f"backbone.conv{i}": (f"backbone.conv{i}",) for i in range(1, 6)},
    **{f"head.{i}": (f"head.cls{i}", f"head.reg{i}") for i in range(1, 4)},
    "everything": tuple(FULL_WIDTHS),
}
_CELL_FORMAT, _SETUP_FORMAT = "psiamfcpp-cell/1", "psiamfcpp-sensitivity/1"
_TAYLOR_BATCHES = 8


@dataclass(frozen=True)
class Setup:
    """What all cells share."""

    model: str
    """name of a shipped model, or a model file"""
    ranks: Path
    """rank table of that model"""
    root: Path
    """folder of sequences to measure on"""
    data: tuple[str, ...]
    """training sets, each LAYOUT:FOLDER; none where nothing is fine-tuned"""
    options: TrainOptions
    """of the fine-tuning"""


@dataclass(frozen=True)
class Cell:
    """One network to make and to measure."""

    row: str
    """a key of `ROWS`, ``unpruned``, or ``paper`` for the plan of the paper's widths"""
    share: float | None = None
    """share of the row's filters that is KEPT"""
    criterion: str = "rank"
    """what chooses the filters"""
    tuned: bool = False
    """whether it is fine-tuned before it is measured"""

    @property
    def name(self) -> str:
        """A name for its file."""
        parts = [self.row, f"{self.share:g}" if self.share else "", self.criterion, "tuned" if self.tuned else ""]
        return "_".join(part for part in parts if part)


def cells(setup: Setup, rows: tuple[str, ...], shares: tuple[float, ...]) -> list[Cell]:
    """The unpruned network, the table of ratios and the comparison of criteria; with and without fine-tuning.

    Where there are no training data, nothing is fine-tuned and ``taylor``, which needs a loss, is left out.
    """
    found = [Cell("unpruned")]
    criteria = [c for c in ("rank", *CRITERIA) if c != "taylor" or setup.data]
    for tuned in (False, True) if setup.data else (False,):
        found += [Cell(row, share, tuned=tuned) for row in rows for share in shares]
        found += [Cell("paper", criterion=criterion, tuned=tuned) for criterion in criteria]
    return found


def measure_all(setup: Setup, wanted: list[Cell], folder: Path, jobs: int = 1) -> Iterator[dict[str, Any]]:
    """Measure cells, in parallel; what a stopped run has measured is not measured again.

    Args:
        setup: what the cells share; a folder's cells all have the same.
        wanted: the cells.
        folder: where each cell leaves a small JSON file.
        jobs: number of processes, each with one thread.

    Yields:
        The result of each cell, those measured before first: ``row``, ``share``, ``criterion``, ``tuned``,
        ``precision``, ``auc``, ``parameters``, ``gmacs``.

    Raises:
        UserError: the folder holds cells of another setup.
    """
    import joblib

    _claim(setup, folder)
    left = []
    for cell in wanted:
        path = folder / f"{cell.name}.json"
        if path.exists():
            yield read_json(path, _CELL_FORMAT, "cell")
        else:
            left.append(cell)
    parallel = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered")
    yield from parallel(joblib.delayed(measure)(setup, cell, folder) for cell in left)


def measure(setup: Setup, cell: Cell, folder: Path) -> dict[str, Any]:
    """Make one network, track with it, and leave the figures in the folder (`otb` convention, plain procedure)."""
    torch.set_num_threads(1)
    run = folder / f"{cell.name}.run"
    run.mkdir(parents=True, exist_ok=True)
    network = _make(setup, cell)
    if cell.tuned:
        sequences = [s for entry in setup.data for s in datasets.read_entry(entry)]
        quiet = RunOptions(workers=0, cache_gb=1.0, save_every=100)
        for _ in train(network, sequences, [], run, setup.options, quiet):
            pass
        network = load(run / MODEL_FILE)
    else:
        save(run / MODEL_FILE, network)
    tracker = Tracker(str(run / MODEL_FILE), options=TrackerOptions("torch", threads=1, plain=True))
    mean = mean_over(tracker, datasets.read("folder", setup.root))
    spec = network.spec
    result = {
        **dataclasses.asdict(cell),
        "precision": mean.figures["precision"],
        "auc": mean.figures["auc"],
        "parameters": count_parameters(network),
        "gmacs": search_macs(spec.widths, spec.search_size) / 1e9,
    }
    write_json(folder / f"{cell.name}.json", {"format": _CELL_FORMAT, **result})
    shutil.rmtree(run)
    return result


def _make(setup: Setup, cell: Cell) -> SiamFCpp:
    """The cell's network before fine-tuning."""
    network = load(setup.model)
    if cell.row == "unpruned":
        return network
    table = RankTable.read(setup.ranks)
    if table.widths != network.spec.widths:
        raise UserError(f"rank table {setup.ranks} is not of {setup.model}: their widths differ")
    if cell.row in ROWS:
        assert cell.share is not None
        return prune_siamfcpp(network, plan(table, dict.fromkeys(ROWS[cell.row], cell.share)))
    counts = {name: kept_count(name, table.widths[name], share) for name, share in PAPER_KEEP.items()}
    chosen = choose(table, counts) if cell.criterion == "rank" else _by(cell.criterion, network, setup, counts)
    return prune_siamfcpp(network, chosen)


def _by(criterion: str, network: SiamFCpp, setup: Setup, counts: dict[str, int]) -> Plan:
    if criterion == "taylor":
        sequences = [s for entry in setup.data for s in datasets.read_entry(entry)]
        loss, size = PairLoss(network, setup.options.losses), setup.options.batch
        for batch in held_out_batches(sequences, setup.options.pairs, _TAYLOR_BATCHES * size, size):
            loss(batch)["total"].backward()
    example = tuple(torch.rand(1, 3, size, size) * 255 for size in (TEMPLATE_SIZE, network.spec.search_size))
    return keep_best(scores(network, example, siamfcpp_groups(network.spec.widths), criterion), counts)


def _claim(setup: Setup, folder: Path) -> None:
    """Note what a folder's cells are of, or refuse if they are of something else."""
    files = [weights_path(setup.model), setup.ranks, *sorted(setup.root.glob("**/groundtruth_rect.txt"))]
    try:
        digests = [hashlib.sha256(path.read_bytes()).hexdigest()[:16] for path in files]
    except OSError as error:
        raise UserError(f"{error.filename} cannot be read: {error.strerror}") from None
    about = json.loads(json.dumps({"files": digests, "data": setup.data, "options": dataclasses.asdict(setup.options)}))
    path = folder / "setup.json"
    if not path.exists():
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"folder {folder} cannot be made: {error.strerror}") from None
        write_json(path, {"format": _SETUP_FORMAT, **about})
    elif read_json(path, _SETUP_FORMAT, "setup") != about:
        raise UserError(f"{folder} holds cells of another model, table, data or training: use another output folder")

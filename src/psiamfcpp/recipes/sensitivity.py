"""What pruning costs: the paper's table of ratios (section 4.5), and criteria compared on one plan."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from psiamfcpp import datasets
from psiamfcpp.datasets.choice import DataChoice
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.ope import mean_over
from psiamfcpp.models import Network, load, save
from psiamfcpp.models.checkpoint import read
from psiamfcpp.models.cost import count_parameters, search_macs
from psiamfcpp.pruning.criteria import CRITERIA, WITH_LOSS, WITH_MAPS, Context, find_criterion, score_table
from psiamfcpp.pruning.models import example_inputs, groups_of, prune_model
from psiamfcpp.pruning.planning import choose, kept_count, plan
from psiamfcpp.pruning.table import read_json, write_json
from psiamfcpp.recipes.scoring import loss_gradients, read_ranks
from psiamfcpp.recipes.sensitivity_report import draw_sensitivity, write_csv
from psiamfcpp.trackers import TrackerOptions
from psiamfcpp.trackers.siamfcpp import Tracker
from psiamfcpp.training.loop import MODEL_FILE, train
from psiamfcpp.training.options import SHORT, RunOptions, TrainOptions
from psiamfcpp.watch import QUIET, Watch
from psiamfcpp.zoo import weights_path

SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
_CELL_FORMAT, _SETUP_FORMAT = "psiamfcpp-cell/1", "psiamfcpp-sensitivity/1"


def sensitivity(
    model: str | Path,
    ranks: str | Path,
    root: str | Path,
    output: str | Path,
    *,
    data: Sequence[str] = (),
    options: TrainOptions = SHORT,
    rows: Sequence[str] = (),
    shares: Sequence[float] = (),
    jobs: int = 1,
    watch: Watch = QUIET,
) -> list[dict[str, Any]]:
    """Measure what pruning each layer costs, and what each criterion makes of the paper's widths.

    Every network is measured by one-pass evaluation with the plain procedure. The folder keeps a file for each, so
    that the same call goes on where it was stopped, table.csv, which grows, and at the end sensitivity.png.

    Args:
        model: name of a shipped model, or a model file.
        ranks: its rank table.
        root: folder of sequences to measure on.
        output: folder of the results.
        data: training sets, each LAYOUT:FOLDER; with them every network is measured after fine-tuning as well.
        options: of the fine-tuning.
        rows: layers to prune alone; by default the rows of the architecture, for SiamFC++ the paper's nine.
        shares: shares of their filters to KEEP; by default `SHARES`.
        jobs: processes to share the work, one thread each.
        watch: receives progress.

    Returns:
        The result of each network, see `measure_all`, in the order of the tables.

    Raises:
        UserError: an unknown row, a value out of range, a file that cannot be read, or a folder of another setup.
    """
    known = read(weights_path(model))[0].arch.ablation
    unknown = next((row for row in rows if row not in known), None)
    if unknown is not None:
        raise UserError(f"unknown row {unknown!r}: known are {', '.join(known)}")
    wrong = next((share for share in shares if not 0 < share <= 1), None)
    if wrong is not None:
        raise UserError(f"the share to keep is {wrong:g}: it must lie above 0 and be at most 1")
    if jobs < 1:
        raise UserError(f"jobs is {jobs}: it must be at least 1")
    output = Path(output)
    setup = Setup(str(model), Path(ranks), Path(root), tuple(data), options)
    wanted = cells(setup, tuple(rows or known), tuple(shares or SHARES))
    order = {(c.row, c.share, c.criterion, c.tuned): number for number, c in enumerate(wanted)}
    done: list[dict[str, Any]] = []
    for result in watch.track(measure_all(setup, wanted, output, jobs), "networks", len(wanted)):
        done.append(result)
        done.sort(key=lambda r: order[r["row"], r["share"], r["criterion"], r["tuned"]])
        write_csv(done, output / "table.csv")
    shutil.rmtree(output / "frames", ignore_errors=True)
    draw_sensitivity(done, output / "sensitivity.png")
    return done


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
    """a row of the architecture's ablation, ``unpruned``, or ``paper`` for the plan of the paper's widths"""
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

    Where there are no training data, nothing is fine-tuned, and criteria that need a loss are left out. Criteria that
    look at maps are compared by `benchmarks/criteria.py`, since they plan by budget and not by the paper's widths.
    """
    found = [Cell("unpruned")]
    criteria = [name for name in CRITERIA if name not in WITH_MAPS and (setup.data or name not in WITH_LOSS)]
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
        sequences = DataChoice(setup.data).training
        # frames of clips are decoded once for all cells
        quiet = RunOptions(workers=0, cache_gb=1.0, save_every=100, frames=str(folder / "frames"))
        for _ in train(network, sequences, [], run, setup.options, quiet):
            pass
        network = load(run / MODEL_FILE)
    else:
        save(run / MODEL_FILE, network)
    tracker = Tracker(str(run / MODEL_FILE), options=TrackerOptions("torch", threads=1, plain=True))
    mean = mean_over(tracker, datasets.read("folder", setup.root))
    result = {
        **dataclasses.asdict(cell),
        "precision": mean.figures["precision"],
        "auc": mean.figures["auc"],
        "parameters": count_parameters(network),
        "gmacs": search_macs(network.spec) / 1e9,
    }
    write_json(folder / f"{cell.name}.json", {"format": _CELL_FORMAT, **result})
    shutil.rmtree(run)
    return result


def _make(setup: Setup, cell: Cell) -> Network:
    """The cell's network before fine-tuning."""
    network = load(setup.model)
    if cell.row == "unpruned":
        return network
    arch, table = network.spec.arch, read_ranks(setup.ranks, network)
    if cell.row in arch.ablation:
        assert cell.share is not None
        return prune_model(network, plan(table, dict.fromkeys(arch.ablation[cell.row], cell.share)))
    counts = {name: kept_count(name, table.widths[name], share) for name, share in arch.presets[cell.row].items()}
    gradients = None
    if cell.criterion in WITH_LOSS:
        gradients = loss_gradients(network, DataChoice(setup.data).training, setup.options)
    context = Context(network, example_inputs(network.spec), table, gradients)
    scored = score_table(groups_of(network.spec), context, find_criterion(cell.criterion))
    return prune_model(network, choose(scored, counts))


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

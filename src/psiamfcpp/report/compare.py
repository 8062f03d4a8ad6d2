"""Trackers side by side: figures of result folders, and what the paper printed, by benchmark."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from psiamfcpp.datasets import BENCHMARKS, Benchmark, Sequence
from psiamfcpp.datasets.attributes import read_attributes
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.measured import CONVENTIONS, Measured, measure
from psiamfcpp.evaluation.metrics import Convention
from psiamfcpp.evaluation.results import Files, find
from psiamfcpp.evaluation.running import RUN_FILE, read_run
from psiamfcpp.report.published import Published, published

PAPER = "Wang et al. 2022"


@dataclass(frozen=True)
class Comparison:
    """Everything about one benchmark."""

    dataset: str
    root: Path
    sequences: list[str]
    labels: int
    measured: list[Measured]
    published: list[Published]
    attributes: dict[str, list[str]]
    """sequences by attribute"""

    @property
    def title(self) -> str:
        """The benchmark's usual name."""
        return title(self.dataset)

    def frames(self) -> dict[str, Sequence]:
        """The sequences with their frames; none where the frames are not at hand."""
        try:
            return {sequence.name: sequence for sequence in BENCHMARKS[self.dataset].read(self.root)}
        except UserError:
            return {}


def title(dataset: str) -> str:
    """A benchmark's usual name."""
    names = {"uav123-10fps": "UAV123@10fps", "visdrone2018": "VisDrone2018", "got10k-val": "GOT-10k val"}
    return names.get(dataset, "Own sequences" if dataset == "folder" else dataset.upper())


def collect(results: list[Path], roots: dict[str, Path] | None = None, allow_missing: bool = False) -> list[Comparison]:
    """Score every tracker in folders of results, benchmark by benchmark.

    Args:
        results: folders that `psiamfcpp evaluate` wrote, which name the benchmark and its root; with ``roots`` also
            those of others.
        roots: labels by benchmark (see `Benchmark.read_labels`); goes before what the folders name.
        allow_missing: score a tracker on the sequences that it has.

    Raises:
        UserError: a folder holds no result, labels are missing, or a result cannot be scored; names which.
    """
    lacking = next((folder for folder in results if not folder.is_dir()), None)
    if lacking is not None:
        raise UserError(f"results folder {lacking} does not exist")
    runs = [(folder, read_run(place) or {}) for folder in results for place in _run_folders(folder)]
    places = {run["dataset"]: Path(run["root"]) for _, run in runs} | (roots or {})
    if not places:
        raise UserError(
            f"{results[0]} holds no run of `psiamfcpp evaluate`: for boxes of others, give --dataset and --annotations"
        )
    comparisons: list[Comparison] = []
    used: set[Path] = set()
    for name in sorted(places, key=list(BENCHMARKS).index):
        if not places[name].is_dir():
            raise UserError(
                f"labels of {name} are not in {places[name]} any more: give --dataset {name} --annotations FOLDER"
            )
        comparison, holding = compare(name, places[name], results, allow_missing)
        used |= holding
        if comparison is None:
            raise UserError(f"no folder holds a result of {name}: leave the benchmark out, or add its results")
        comparisons.append(comparison)
    idle = next((folder for folder in results if folder not in used), None)
    if idle is not None:
        raise UserError(f"{idle} holds no result of {' or '.join(places)}: leave it out, or give its --dataset")
    return comparisons


def compare(
    name: str, root: Path, results: list[Path], allow_missing: bool = False
) -> tuple[Comparison | None, set[Path]]:
    """Score every tracker in folders of results on one benchmark.

    Args:
        name: the benchmark.
        root: its labels.
        results: folders; one without a result of this benchmark is passed over.
        allow_missing: score a tracker on the sequences that it has.

    Returns:
        The comparison, None where no folder holds a result, and the folders that do.

    Raises:
        UserError: the labels cannot be read, two trackers have one name, or a result cannot be scored.
    """
    benchmark = BENCHMARKS[name]
    unread: dict[str, str] = {}
    labels = benchmark.read_labels(root, unread if allow_missing else None)
    trackers: dict[str, Files] = {}
    used: set[Path] = set()
    for folder in results:
        found = _trackers(folder, benchmark, list(labels))
        used |= {folder} if found else set()
        twice = next(iter(found.keys() & trackers.keys()), None)
        if twice is not None:
            raise UserError(f"{folder} holds a second tracker called {twice}: rename its folder")
        trackers |= found
    if not trackers:
        return None, used
    measured = [
        measure(tracker, name, files, labels, CONVENTIONS, allow_missing, unread) for tracker, files in trackers.items()
    ]
    rows = [row for row in published() if row.dataset == name]
    attributes = read_attributes(name, root, list(labels))
    return Comparison(name, root, list(labels), sum(map(len, labels.values())), measured, rows, attributes), used


def average(comparisons: list[Comparison], tracker: str, convention: Convention, figure: str) -> float | None:
    """A tracker's figure, averaged over the benchmarks; None if it lacks one."""
    found = [m.mean[convention].figures[figure] for c in comparisons for m in c.measured if m.tracker == tracker]
    return sum(found) / len(found) if len(found) == len(comparisons) else None


def _run_folders(folder: Path) -> list[Path]:
    """Folders of one tracker each: the folder itself, or those one or two below it."""
    return [path.parent for depth in ("", "*/", "*/*/") for path in sorted(folder.glob(depth + RUN_FILE))]


def _trackers(folder: Path, benchmark: Benchmark, sequences: list[str]) -> dict[str, Files]:
    """Trackers of a folder that have results of a benchmark; none if there are none."""
    try:
        found = find(folder, (benchmark.name, *benchmark.folders[:1]), sequences)
    except UserError:
        return {}
    # A run says what it is of: sequences of another benchmark may bear the same names.
    runs = {name: read_run(next(iter(files.values())).parent) for name, files in found.items() if files}
    return {name: found[name] for name, run in runs.items() if run is None or run["dataset"] == benchmark.name}

"""Reproduce the paper's tables and figures: find the benchmarks, plan the runs, run what is not done, write a page."""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from psiamfcpp.datasets import BENCHMARKS
from psiamfcpp.datasets import Sequence as Labelled
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.running import is_done, run
from psiamfcpp.recipes.find import Found, find_benchmark
from psiamfcpp.recipes.reproduce_ratios import ratios_left, read_ratios, run_ratios
from psiamfcpp.recipes.reproduce_time import seconds_per_frame
from psiamfcpp.report.compare import Comparison, compare, title
from psiamfcpp.report.layout import Cell, Row, Table
from psiamfcpp.report.published import averaged, published
from psiamfcpp.report.reproduction import BASELINE, ON_GPU, PRUNED, Reproduction, paper_name, tables
from psiamfcpp.trackers import TrackerChoice, TrackerOptions, choose
from psiamfcpp.trackers.dcf import FILTERS
from psiamfcpp.trackers.trax.adapter import adapters
from psiamfcpp.watch import QUIET, Watch

MODELS = {BASELINE: "siamfcpp-alexnet", PRUNED: "psiamfcpp-alexnet"}
TABLES = (1, 2, 3, 4)
_DEEP = "uavdt"
"""the benchmark of Table 2"""


@dataclass(frozen=True)
class Planned:
    """Runs of one tracker on one benchmark that are not done yet."""

    dataset: str
    tracker: str
    sequences: int
    frames: int
    seconds: float | None
    """estimate for one process; None where the tracker cannot follow the first of the sequences"""


@dataclass(frozen=True)
class Reproduced:
    """What `reproduce` found, did and made."""

    found: dict[str, Found | None]
    """what is there of each of the four benchmarks"""
    planned: list[Planned]
    """what was not done yet when it began"""
    problems: list[str]
    """one line about each tracker or sequence that could not be run"""
    tables: dict[int, Table] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    """the page first; none without an output folder"""


@dataclass(frozen=True)
class _Work:
    """One benchmark with its frames, and the trackers to run over it."""

    dataset: str
    root: Path
    sequences: list[Labelled]
    choices: list[TrackerChoice]

    def pending(self, choice: TrackerChoice, results: Path | None) -> list[Labelled]:
        if results is None:
            return self.sequences
        return [s for s in self.sequences if not is_done(results / self.dataset / choice.name, s)]


def reproduce(
    root: str | Path | None = None,
    output: str | Path | None = None,
    wanted: Sequence[int] = (),
    checkouts: Sequence[str] = (),
    results: Sequence[str | Path] = (),
    ranks: str | Path | None = None,
    data: Sequence[str] = (),
    finetune_steps: int = 200,
    jobs: int = 1,
    cluster: str | None = None,
    dry_run: bool = False,
    watch: Watch = QUIET,
) -> Reproduced:
    """Set the paper's tables and figures beside ours, from whatever is there.

    Without frames, result files are scored; without labels, the published side alone is shown. Runs go on where an
    earlier call was stopped. Table 4 is run only where a rank table or training data are given.

    Args:
        root: folder that holds the benchmarks' folders.
        output: folder for results, page, tables and plots; needed where something is to be run.
        wanted: numbers of the tables to make, 1 to 4; by default all.
        checkouts: deep trackers, each ``[adapter:]NAME,checkout=DIR,weights=FILE[,python=PY][,device=cuda]``.
        results: folders of boxes of others, scored beside ours.
        ranks: rank table of SiamFC++ for Table 4; made from ``data`` where it is not given.
        data: training sets for the fine-tuning of Table 4, each LAYOUT:FOLDER; without them nothing is fine-tuned.
        finetune_steps: budget of each network of Table 4.
        jobs: sequences that are run side by side; leave it at 1 to measure speed.
        cluster: address of a Dask scheduler whose workers run the sequences instead.
        dry_run: plan only; nothing is run or written.
        watch: receives progress and notes.

    Raises:
        UserError: an option is out of range, a folder is missing, or an output folder is needed.
        ModuleNotFoundError: matplotlib or jinja2 is not installed (extra ``report``).
    """
    root, output, ranks = (None if path is None else Path(path) for path in (root, output, ranks))
    folders = [Path(folder) for folder in results]
    _check(root, wanted, folders, finetune_steps, jobs)
    chosen = tuple(wanted) or TABLES
    found = {name: find_benchmark(BENCHMARKS[name], root) if root else None for name in averaged()}
    own = (output / "results").resolve() if output else None
    work = list(_work(found, chosen, checkouts)) if root else []
    planned, problems, work = _plan(work, own, watch)
    with_ratios = 4 in chosen and bool(ranks or data) and bool(found["dtb70"] and found["dtb70"].frames)
    if with_ratios:
        planned += _plan_ratios(found, output, own, bool(data))
    if dry_run:
        return Reproduced(found, planned, problems)
    if output is None and (planned or with_ratios):
        raise UserError("frames are there and runs are to be done: give -o DIR for results and page, or --dry-run")
    # What is wrong with them must be said before hours of runs.
    theirs = _score(found, folders)
    if output:
        # So must be the absence of these.
        import jinja2  # noqa: F401
        import matplotlib  # noqa: F401
    for part in work:
        assert own is not None
        problems += run(part.choices, part.dataset, part.root, part.sequences, own, jobs, cluster, watch)
    if output and found["dtb70"] and with_ratios:
        place = Path(found["dtb70"].root)
        run_ratios(MODELS[BASELINE], place, output / "table4", ranks, data, finetune_steps, jobs, watch)
    comparisons = _merged(_score(found, [own] if own and own.is_dir() else []), theirs)
    cells, budget = read_ratios(output / "table4") if output else ([], 0)
    ours = Reproduction(comparisons, _parameters(), cells, budget)
    made = tables(ours, chosen)
    files: list[Path] = []
    if output:
        from psiamfcpp.report.reproduction_page import write_reproduction

        files = write_reproduction(ours, made, there(found), problems, output)
    return Reproduced(found, planned, problems, made, files)


def there(found: dict[str, Found | None]) -> Table:
    """Return a table of what is there of each benchmark, and where to get what is missing."""
    lines = []
    for name, place in found.items():
        benchmark = BENCHMARKS[name]
        if place is None or not place.sequences:
            said = f"not found; from {benchmark.source}; expected layout: {benchmark.layout}"
        elif not place.frames:
            said = f"labels only, results are scored; frames from {benchmark.source}"
            said += f"; {(place.problem or '').partition('; expected layout')[0]}"
        elif place.sequences != benchmark.size:
            said = f"not the whole benchmark of {benchmark.size} sequences: its figures are not the paper's"
        else:
            said = "whole"
        counts = [str(getattr(place, key) if place else 0) for key in ("sequences", "labels", "frames")]
        lines.append(Row(title(name), [*map(Cell, counts), Cell(said.removesuffix("; "))]))
    caption = "The paper's four benchmarks, and what of them was found."
    return Table(caption, ["Benchmark", "Sequences", "Labels", "Frames", "State"], lines, prose=["State"])


def _check(root: Path | None, wanted: Sequence[int], results: Sequence[Path], steps: int, jobs: int) -> None:
    if root is not None and not root.is_dir():
        raise UserError(f"folder {root} does not exist: give the folder that holds the benchmarks' folders")
    unknown = next((number for number in wanted if number not in TABLES), None)
    if unknown is not None:
        raise UserError(f"table {unknown} is not in the paper: give 1, 2, 3 or 4")
    if results and root is None:
        raise UserError("--results needs the labels: give --root")
    lacking = next((folder for folder in results if not folder.is_dir()), None)
    if lacking is not None:
        raise UserError(f"results folder {lacking} does not exist")
    if jobs < 1 or steps < 1:
        raise UserError(f"--jobs is {jobs} and --finetune-steps {steps}: both must be at least 1")


def _work(found: dict[str, Found | None], wanted: Iterable[int], checkouts: Sequence[str]) -> Iterable[_Work]:
    """Yield each benchmark whose frames are there, with the trackers that the wanted tables have on it."""
    ours, on_gpu = _models()
    filters = _filters() if 1 in wanted else []
    deep = [_adapter(text) for text in checkouts]
    for name, place in found.items():
        if place is None or not place.frames:
            continue
        choices: list[TrackerChoice] = []
        if 1 in wanted or 3 in wanted or (2 in wanted and name == _DEEP):
            choices += [choice for choice in ours if 3 in wanted or choice.name == PRUNED]
        if 3 in wanted or (2 in wanted and name == _DEEP):
            choices += [choice for choice in on_gpu if 3 in wanted or choice.name == PRUNED + ON_GPU]
        choices += filters
        if 2 in wanted and name == _DEEP:
            choices += deep
        if choices:
            yield _Work(name, Path(place.root), BENCHMARKS[name].read(Path(place.root)), choices)


def _models() -> tuple[list[TrackerChoice], list[TrackerChoice]]:
    """Return our two networks by the published procedure: on the processor, and on a GPU where torch finds one.

    They run in float32 in torch, as the paper's do; without torch in 8 bits.
    """
    if importlib.util.find_spec("torch") is None:
        return [_labelled(f"{model}-int8,plain=true", name) for name, model in MODELS.items()], []
    import torch

    ours = [_labelled(f"{model},engine=torch,plain=true", name) for name, model in MODELS.items()]
    if not torch.cuda.is_available():
        return ours, []
    gpu = [_labelled(f"{model},engine=torch,device=cuda,plain=true", name + ON_GPU) for name, model in MODELS.items()]
    return ours, gpu


def _filters() -> list[TrackerChoice]:
    """Return the correlation filters of Table 1 that this package has."""
    wanted = {row.tracker for row in published() if row.source.startswith("Table 1,")}
    return [_labelled(f"dcf:{name}", paper_name(name)) for name in FILTERS if paper_name(name) in wanted]


def _adapter(text: str) -> TrackerChoice:
    name = text.removeprefix("adapter:").partition(",")[0]
    if name not in adapters():
        raise UserError(f"unknown adapter {name!r}: there are {', '.join(adapters())}")
    return _labelled(f"adapter:{text.removeprefix('adapter:')}", paper_name(adapters()[name]["name"]))


def _labelled(tracker: str, label: str) -> TrackerChoice:
    return dataclasses.replace(choose(tracker, TrackerOptions()), label=label)


def _plan(work: list[_Work], results: Path | None, watch: Watch) -> tuple[list[Planned], list[str], list[_Work]]:
    """Return what is to be done, with an estimate; what cannot be opened; and the work without that."""
    pending = [(part, choice, part.pending(choice, results)) for part in work for choice in part.choices]
    pending = [(part, choice, sequences) for part, choice, sequences in pending if sequences]
    rates: dict[str, float | None] = {}
    closed: set[str] = set()
    problems: list[str] = []
    timed = {choice.name: (choice, sequences[0]) for _, choice, sequences in pending}
    for name, (choice, sequence) in watch.track(timed.items(), "timing trackers", len(timed)):
        try:
            rates[name] = seconds_per_frame(choice, sequence, results)
        except UserError as error:
            rates[name] = None
            closed.add(name)
            problems.append(f"{name} is left out: {error}")
    planned = [
        Planned(part.dataset, choice.name, len(sequences), frames, rate and rate * frames)
        for part, choice, sequences in pending
        if choice.name not in closed
        for frames, rate in [(sum(map(len, sequences)), rates[choice.name])]
    ]
    usable = [dataclasses.replace(part, choices=[c for c in part.choices if c.name not in closed]) for part in work]
    return planned, problems, [part for part in usable if part.choices]


def _plan_ratios(
    found: dict[str, Found | None], output: Path | None, results: Path | None, tuned: bool
) -> list[Planned]:
    """Return the networks of Table 4 that are left, each as slow as the unpruned one; fine-tuning is not counted."""
    left = ratios_left(output / "table4" if output else None, tuned)
    place = found["dtb70"]
    if not left or place is None:
        return []
    sequences = BENCHMARKS["dtb70"].read(Path(place.root))
    rate = seconds_per_frame(_models()[0][0], sequences[0], results)
    frames = left * place.frames
    return [Planned("dtb70", f"{left} networks of Table 4", left * len(sequences), frames, rate and rate * frames)]


def _score(found: dict[str, Found | None], folders: Sequence[Path]) -> dict[str, Comparison]:
    """Score the results in folders, by benchmark; benchmarks of which there are none are absent."""
    scored = {}
    for name, place in found.items():
        if place is not None and place.sequences and folders:
            comparison, _ = compare(name, Path(place.root), list(folders), allow_missing=True)
            if comparison is not None:
                scored[name] = comparison
    return scored


def _merged(ours: dict[str, Comparison], theirs: dict[str, Comparison]) -> list[Comparison]:
    """Return both side by side, by benchmark; of two trackers of one name ours stands."""
    merged = []
    for name in averaged():
        first, second = ours.get(name), theirs.get(name)
        if first is not None and second is not None:
            known = {entry.tracker for entry in first.measured}
            others = [entry for entry in second.measured if entry.tracker not in known]
            first = dataclasses.replace(first, measured=[*first.measured, *others])
        either = first or second
        if either is not None:
            merged.append(either)
    return merged


def _parameters() -> dict[str, int]:
    """Return the parameters of our networks; nothing without torch."""
    if importlib.util.find_spec("torch") is None:
        return {}
    from psiamfcpp.models.checkpoint import read
    from psiamfcpp.models.cost import facts
    from psiamfcpp.zoo import weights_path

    return {name: facts(read(weights_path(model))[0])["parameters"] for name, model in MODELS.items()}

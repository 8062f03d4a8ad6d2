"""Run trackers over a benchmark and score them."""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from psiamfcpp.datasets import BENCHMARKS, BenchmarkName
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.measured import CONVENTIONS, Measured
from psiamfcpp.evaluation.running import result_files, run
from psiamfcpp.recipes.find import find_benchmark
from psiamfcpp.recipes.score import measure_all
from psiamfcpp.trackers import TrackerChoice, TrackerOptions, choose
from psiamfcpp.watch import QUIET, Watch
from psiamfcpp.zoo import DEFAULT_MODEL

_DEFAULT = TrackerOptions()


def evaluate(
    root: str | Path,
    dataset: BenchmarkName = "folder",
    trackers: Sequence[str] = (DEFAULT_MODEL,),
    results: str | Path | None = None,
    jobs: int = 1,
    cluster: str | None = None,
    allow_missing: bool = False,
    options: TrackerOptions = _DEFAULT,
    names: Sequence[str] = (),
    watch: Watch = QUIET,
) -> list[Measured]:
    """Run trackers over a benchmark, or a folder of sequences, and score them (one-pass evaluation).

    Args:
        root: the benchmark's folder; for `folder`, one of sequences, each with img/ and groundtruth_rect.txt.
        dataset: name of the benchmark.
        trackers: as of `psiamfcpp.open_tracker`.
        results: folder to keep boxes and times in, written sequence by sequence; what it holds is not run again.
        jobs: sequences that are run side by side; leave it at 1 to measure speed.
        cluster: address of a Dask scheduler (tcp://HOST:PORT) whose workers run the sequences instead.
        allow_missing: score a tracker on the sequences that could be run.
        options: how our models run.
        names: what tables and folders of results call each tracker, so that one model with two settings can stand
            side by side; by default their own names.
        watch: receives progress, and one line about each sequence that could not be run.

    Returns:
        One entry per tracker, in both conventions.

    Raises:
        UserError: the benchmark cannot be read, a tracker cannot be opened, or a sequence could not be run and
            ``allow_missing`` is false.
    """
    if jobs < 1:
        raise UserError(f"--jobs is {jobs}: it must be at least 1")
    if not trackers:
        raise UserError("--tracker names none: give a model, or another as opencv:mil")
    root, results = Path(root), None if results is None else Path(results)
    choices = _named([choose(entry, options) for entry in trackers], names)
    unread: dict[str, str] = {}
    sequences = BENCHMARKS[dataset].read(root.resolve(), unread if allow_missing else None)
    with contextlib.ExitStack() as stack:
        place = results or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        problems = run(choices, dataset, root, sequences, place, jobs, cluster, watch)
        _check(problems, allow_missing, results, watch)
        labels = {sequence.name: sequence.boxes for sequence in sequences}
        files = {choice.name: result_files(place / dataset / choice.name, sequences) for choice in choices}
        return measure_all(dataset, labels, files, CONVENTIONS, allow_missing, watch, unread)


def evaluate_several(
    root: Path, datasets: Sequence[BenchmarkName], evaluate_one: Callable[[Path, BenchmarkName], list[Measured]]
) -> dict[BenchmarkName, list[Measured]]:
    """Evaluate several benchmarks one after the other, once all of them are found.

    Args:
        root: of one benchmark its folder; of several the folder that holds theirs.
        datasets: names of the benchmarks.
        evaluate_one: evaluates the benchmark of a name in its folder, normally by `evaluate`.

    Returns:
        What ``evaluate_one`` returned, by benchmark.

    Raises:
        UserError: a benchmark is not there, or as of ``evaluate_one``.
    """
    roots = {name: root if len(datasets) == 1 else _root_of(name, root) for name in datasets}
    return {name: evaluate_one(place, name) for name, place in roots.items()}


def _root_of(name: BenchmarkName, root: Path) -> Path:
    if not root.is_dir():
        raise UserError(f"dataset folder {root} does not exist: --root names the folder that holds the benchmarks")
    found = find_benchmark(BENCHMARKS[name], root)
    if found is None or not found.frames:
        why = f": {found.problem}" if found and found.problem else f"; get it from {BENCHMARKS[name].source}"
        raise UserError(f"{root} holds no frames of {name}{why}")
    return Path(found.root)


def _named(choices: list[TrackerChoice], names: Sequence[str]) -> list[TrackerChoice]:
    """Return the trackers under the names that they were given.

    Raises:
        UserError: there are more or fewer names than trackers, or one cannot be a folder's.
    """
    if not names:
        return choices
    if len(names) != len(choices):
        raise UserError(f"--name gives {len(names)} names, but --tracker {len(choices)} trackers: give one each")
    wrong = next((name for name in names if not name.strip() or name[0] == "." or set(name) & set("/\\\0")), None)
    if wrong is not None:
        raise UserError(f"name {wrong!r} cannot be that of a folder: use letters, digits, - and _")
    return [dataclasses.replace(choice, label=name) for choice, name in zip(choices, names, strict=True)]


def _check(problems: list[str], allow_missing: bool, results: Path | None, watch: Watch) -> None:
    """Pass on what could not be run; without leave for that, raise the first of it."""
    for problem in problems if allow_missing else problems[1:]:
        watch.note(problem)
    if problems and not allow_missing:
        kept = f"; what could be run is kept in {results}" if results else ""
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise UserError(f"{problems[0]}{more}{kept}; --allow-missing scores the rest")

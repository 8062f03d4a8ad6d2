"""`psiamfcpp evaluate`."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path
from typing import Any

from psiamfcpp import datasets
from psiamfcpp.cli.output import notes, print_json, progress
from psiamfcpp.cli.score import BOTH, print_head, print_tables, score_rows
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.results import Files, read_speed
from psiamfcpp.evaluation.running import CONDITIONS, read_run, result_files, run
from psiamfcpp.trackers import TrackerOptions, choose
from psiamfcpp.zoo import DEFAULT_MODEL


def evaluate(
    root: Path,
    dataset: datasets.BenchmarkName = "folder",
    tracker: tuple[str, ...] = (DEFAULT_MODEL,),
    results: Path | None = None,
    jobs: int = 1,
    cluster: str | None = None,
    allow_missing: bool = False,
    options: TrackerOptions = TrackerOptions(),  # noqa: B008 - frozen
    json: bool = False,
) -> None:
    """Run trackers over a benchmark, or a folder of sequences, and score them (one-pass evaluation, both conventions).

    Args:
        root: the benchmark's folder; for `folder`, one of sequences, each with img/ and groundtruth_rect.txt.
        dataset: name of the benchmark.
        tracker: shipped models, model files, and others, as opencv:mil, opencv:nano,backbone=FILE,neckhead=FILE,
            dcf:kcf, or module:pkg.mod:Class with init(image, box) and update(image).
        results: folder to keep boxes and times in, written sequence by sequence; what it holds is not run again.
        jobs: sequences that are run side by side; leave it at 1 to measure speed.
        cluster: run on the workers of a Dask scheduler (tcp://HOST:PORT) instead.
        allow_missing: score a tracker on the sequences that could be run, and say how many could not.
        options: how our models run.
        json: print one JSON object.
    """
    if jobs < 1:
        raise UserError(f"--jobs is {jobs}: it must be at least 1")
    if not tracker:
        raise UserError("--tracker names none: give a model, or another as opencv:mil")
    choices = [choose(entry, options) for entry in tracker]
    sequences = datasets.BENCHMARKS[dataset].read(root.resolve())
    with contextlib.ExitStack() as stack:
        place = results or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        with progress() as bar:
            task = bar.add_task("sequences", total=len(choices) * len(sequences))
            problems = run(
                choices, dataset, root, sequences, place, jobs, cluster, lambda count: bar.advance(task, count)
            )
        _report(problems, allow_missing, results)
        labels = {sequence.name: sequence.boxes for sequence in sequences}
        folders = {choice.name: place / dataset / choice.name for choice in choices}
        files = {name: result_files(folder, sequences) for name, folder in folders.items()}
        rows = score_rows(dataset, labels, files, BOTH, allow_missing)
        speeds = {name: _speed(folder, files[name]) for name, folder in folders.items()}
    rows = [{**row, **speeds[row["tracker"]]} for row in rows]
    if json:
        print_json({"results": rows})
        return
    print_head(dataset, labels)
    print_tables(rows, per_sequence=len(tracker) == 1)
    print()
    for name, speed in speeds.items():
        print(f"{name}: {_describe(speed)}")


def _report(problems: list[str], allow_missing: bool, results: Path | None) -> None:
    """Say what could not be run; without leave for that, as an error."""
    for problem in problems if allow_missing else problems[1:]:
        notes.print(problem)
    if problems and not allow_missing:
        kept = f"; what could be run is kept in {results}" if results else ""
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise UserError(f"{problems[0]}{more}{kept}; --allow-missing scores the rest")


def _speed(folder: Path, files: Files) -> dict[str, Any]:
    """Frames a second, and under what conditions they were measured."""
    speed, facts = read_speed(files), read_run(folder) or {}
    figures = {"fps": None, "fps_mean": None} if speed is None else {"fps": speed.median, "fps_mean": speed.mean}
    return {**figures, **{key: facts.get(key) for key in CONDITIONS}}


def _describe(speed: dict[str, Any]) -> str:
    if speed["fps"] is None:
        return "no speed, for want of a second frame"
    count = speed["threads"]
    threads = "an unknown number of threads" if count is None else f"{count} thread{'s' * (count > 1)}"
    text = f"{speed['fps']:.1f} fps (median; mean {speed['fps_mean']:.1f}), decoding apart, {threads}"
    beside = f"; {speed['jobs']} ran side by side, which slows each" if speed["jobs"] > 1 else ""
    return f"{text}, {speed['processor']}{beside}"

"""`psiamfcpp evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from psiamfcpp import datasets
from psiamfcpp.cli.arguments import Json
from psiamfcpp.cli.output import print_json, watching
from psiamfcpp.cli.score import print_measured
from psiamfcpp.evaluation.measured import CONVENTIONS
from psiamfcpp.recipes.evaluate import evaluate as run_benchmark
from psiamfcpp.recipes.evaluate import evaluate_several
from psiamfcpp.trackers import TrackerOptions
from psiamfcpp.zoo import DEFAULT_MODEL


def evaluate(
    root: Path,
    dataset: tuple[datasets.BenchmarkName, ...] = ("folder",),
    tracker: tuple[str, ...] = (DEFAULT_MODEL,),
    results: Path | None = None,
    jobs: int = 1,
    cluster: str | None = None,
    allow_missing: bool = False,
    name: tuple[str, ...] = (),
    options: TrackerOptions = TrackerOptions(),  # noqa: B008 - frozen
    json: Json = False,
) -> None:
    """Run trackers over benchmarks, or a folder of sequences, and score them (one-pass evaluation, both conventions).

    Args:
        root: the benchmark's folder; for `folder`, one of sequences, each with img/ and groundtruth_rect.txt. For
            several benchmarks, the folder that holds theirs.
        dataset: names of the benchmarks.
        tracker: shipped models, model files, and others, as opencv:mil, opencv:nano,backbone=FILE,neckhead=FILE,
            dcf:kcf, or module:pkg.mod:Class with init(image, box) and update(image).
        results: folder to keep boxes and times in, written sequence by sequence; what it holds is not run again.
        jobs: sequences that are run side by side; leave it at 1 to measure speed.
        cluster: run on the workers of a Dask scheduler (tcp://HOST:PORT) instead.
        allow_missing: score a tracker on the sequences that could be run, and say how many could not.
        name: what tables and folders of results call each tracker, so that one model with two settings can stand side
            by side.
        options: how our models run.
    """
    with watching() as watch:
        done = evaluate_several(
            root,
            dataset,
            lambda place, benchmark: run_benchmark(
                place, benchmark, tracker, results, jobs, cluster, allow_missing, options, name, watch
            ),
        )
    if json:
        every = [entry for measured in done.values() for entry in measured]
        print_json({"results": [entry.row(kind) for entry in every for kind in CONVENTIONS]})
        return
    for number, (benchmark, measured) in enumerate(done.items()):
        print("\n" * (number > 0), end="")
        print_measured(benchmark, measured, CONVENTIONS, False)
        print()
        for entry in measured:
            print(f"{entry.tracker}: {_describe(entry.row('otb'))}")


def _describe(speed: dict[str, Any]) -> str:
    if speed["fps"] is None:
        return "no speed, for want of a second frame"
    count = speed["threads"]
    threads = "an unknown number of threads" if count is None else f"{count} thread{'s' * (count > 1)}"
    text = f"{speed['fps']:.1f} fps (median; mean {speed['fps_mean']:.1f}), decoding apart, {threads}"
    beside = f"; {speed['jobs']} ran side by side, which slows each" if speed["jobs"] > 1 else ""
    return f"{text}, {speed['processor']}{beside}"

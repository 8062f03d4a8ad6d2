"""`psiamfcpp evaluate`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from psiamfcpp import datasets
from psiamfcpp.cli.output import print_json, progress
from psiamfcpp.evaluation.metrics import Convention, Scores, score_sequence
from psiamfcpp.evaluation.ope import one_pass
from psiamfcpp.evaluation.table import result_row
from psiamfcpp.tracking import Tracker
from psiamfcpp.zoo import DEFAULT_MODEL


def evaluate(
    root: Path,
    dataset: datasets.BenchmarkName = "folder",
    tracker: str = DEFAULT_MODEL,
    engine: str | None = None,
    threads: int | None = None,
    search_size: int | None = None,
    plain: bool = False,
    json: bool = False,
) -> None:
    """Run a tracker over a benchmark, or a folder of sequences, and score it (one-pass evaluation, both conventions).

    Args:
        root: the benchmark's folder; for `folder`, one of sequences, each with img/ and groundtruth_rect.txt.
        dataset: name of the benchmark.
        tracker: name of a shipped model, or a model file.
        engine: what runs the network.
        threads: threads of the engine; by default all cores.
        search_size: side of the search crop in pixels.
        plain: the published procedure, without states and without looking for a lost target.
        json: print one JSON object.
    """
    follower = Tracker(tracker, engine, threads, search_size, plain)
    sequences = datasets.BENCHMARKS[dataset].read(root)
    scores: dict[Convention, dict[str, Scores]] = {"otb": {}, "got10k": {}}
    speeds: list[float] = []
    with progress() as bar:
        for sequence in bar.track(sequences, description="sequences"):
            run = one_pass(follower, sequence)
            speeds.extend(run.seconds[1:])
            for convention in scores:
                scores[convention][sequence.name] = score_sequence(sequence.boxes, run.boxes, convention)
    fps = float(1 / np.median(speeds)) if speeds else 0.0
    results = [result_row(tracker, dataset, convention, by_name, fps) for convention, by_name in scores.items()]
    if json:
        print_json({"results": results})
        return
    print(f"{'sequence':30} precision   AUC   (otb)")
    for name, figures in results[0]["sequences"].items():
        print(f"{name:30}   {figures['precision']:.3f}   {figures['auc']:.3f}")
    for row in results:
        print(f"mean, {row['convention']:24}   {row['precision']:.3f}   {row['auc']:.3f}")
    print(f"{fps:.1f} fps")

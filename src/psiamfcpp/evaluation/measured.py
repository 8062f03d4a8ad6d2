"""What a tracker scored on a benchmark: the one form in which commands print it and the report shows it."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from psiamfcpp.datasets import BENCHMARKS
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.metrics import Convention, Scores, mean_scores
from psiamfcpp.evaluation.results import Files, Speed, read_result, read_speed, score_results, without_result
from psiamfcpp.evaluation.running import CONDITIONS, read_run
from psiamfcpp.geometry import FloatArray

CONVENTIONS: tuple[Convention, ...] = ("otb", "got10k")


@dataclass(frozen=True)
class Measured:
    """A tracker on a benchmark, from its result files."""

    tracker: str
    dataset: str
    labels: int
    """labelled frames of the whole benchmark"""
    mean: dict[Convention, Scores]
    figures: dict[Convention, dict[str, dict[str, float]]]
    """by convention and sequence"""
    left_out: dict[str, str]
    """why sequences do not count, by name: no result, or one that does not fit"""
    speed: Speed | None
    run: dict[str, Any] | None
    """what `psiamfcpp.evaluation.running` noted of the run; None for boxes of other origin"""
    files: Files

    @property
    def missing(self) -> int:
        """Number of sequences that do not count."""
        return len(self.left_out)

    def boxes(self, sequence: str, rows: int) -> FloatArray:
        """Return the boxes ``(rows, 4)`` of a sequence.

        Raises:
            UserError: as of `read_result`.
        """
        return read_result(self.files[sequence], rows, functools.partial(BENCHMARKS[self.dataset].counted, sequence))

    @property
    def source(self) -> str:
        """Where the figures come from."""
        if self.run is None:
            return "result files"
        count = self.run["threads"]
        threads = f", {count} thread{'s' * (count > 1)}" if count else ""
        beside = f", {self.run['jobs']} side by side" if self.run["jobs"] > 1 else ""
        return f"run on {self.run['processor']}{threads}{beside}"

    def row(self, convention: Convention) -> dict[str, Any]:
        """Return the figures in one convention, as commands print them with ``--json``."""
        mean, speed = self.mean[convention], self.speed
        return {
            "tracker": self.tracker,
            "dataset": self.dataset,
            "convention": convention,
            **mean.figures,
            "invalid_rows": mean.invalid,
            "sequences": self.figures[convention],
            "missing_sequences": self.missing,
            "left_out": self.left_out,
            "fps": speed.median if speed else None,
            "fps_mean": speed.mean if speed else None,
            **({key: self.run[key] for key in CONDITIONS} if self.run else {}),
        }


def measure(
    tracker: str,
    dataset: str,
    files: Files,
    labels: dict[str, FloatArray],
    conventions: Sequence[Convention] = CONVENTIONS,
    allow_missing: bool = False,
    unread: Mapping[str, str] | None = None,
) -> Measured:
    """Score a tracker's result files.

    Args:
        tracker: its name.
        dataset: name of the benchmark.
        files: result files by sequence, at least one.
        labels: ``(n, 4)`` by sequence.
        conventions: what rows without a valid label count for.
        allow_missing: score the sequences that have a result that fits.
        unread: why sequences have no labels, by name.

    Raises:
        UserError: without ``allow_missing`` a sequence has no result, or one that cannot be scored; or none can be.
    """
    left_out = {**(unread or {}), **without_result(tracker, files, labels, allow_missing)}
    counted = BENCHMARKS[dataset].counted
    scores = score_results(labels, files, list(conventions), counted, left_out if allow_missing else None)
    files = {name: path for name, path in files.items() if name not in left_out}
    if not files:
        first = next(reason for reason in left_out.values() if reason != "no result")
        raise UserError(f"tracker {tracker} has no result that fits, the first: {first}")
    return Measured(
        tracker,
        dataset,
        sum(map(len, labels.values())),
        {kind: mean_scores(by_name.values()) for kind, by_name in scores.items()},
        {kind: {name: s.figures for name, s in by_name.items()} for kind, by_name in scores.items()},
        left_out,
        read_speed(files),
        read_run(next(iter(files.values())).parent),
        files,
    )

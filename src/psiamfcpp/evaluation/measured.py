"""What a tracker scored on a benchmark: the one form in which commands print it and the report shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from psiamfcpp.evaluation.metrics import Convention, Scores, mean_scores
from psiamfcpp.evaluation.results import Files, Speed, count_missing, read_speed, score_results
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
    missing: int
    """sequences without a result"""
    speed: Speed | None
    run: dict[str, Any] | None
    """what `psiamfcpp.evaluation.running` noted of the run; None for boxes of other origin"""
    files: Files

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
) -> Measured:
    """Score a tracker's result files.

    Args:
        tracker: its name.
        dataset: name of the benchmark.
        files: result files by sequence, at least one.
        labels: ``(n, 4)`` by sequence.
        conventions: what rows without a valid label count for.
        allow_missing: score the sequences that have a result.

    Raises:
        UserError: a sequence has no result without ``allow_missing``, or a result cannot be scored.
    """
    missing = count_missing(tracker, files, labels, allow_missing)
    scores = score_results(labels, files, list(conventions))
    return Measured(
        tracker,
        dataset,
        sum(map(len, labels.values())),
        {kind: mean_scores(by_name.values()) for kind, by_name in scores.items()},
        {kind: {name: s.figures for name, s in by_name.items()} for kind, by_name in scores.items()},
        missing,
        read_speed(files),
        read_run(next(iter(files.values())).parent),
        files,
    )

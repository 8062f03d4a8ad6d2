"""The one form in which figures are handed out: a row for a tracker, a benchmark and a convention."""

from __future__ import annotations

from typing import Any

from psiamfcpp.evaluation.metrics import Convention, Scores, mean_scores


def result_row(
    tracker: str, dataset: str, convention: Convention, by_name: dict[str, Scores], fps: float | None
) -> dict[str, Any]:
    """Figures of a tracker, as commands print them with ``--json``.

    Args:
        tracker: its name.
        dataset: name of the benchmark.
        convention: the convention that the scores follow.
        by_name: scores by sequence, at least one.
        fps: frames a second; None where it is not known.
    """
    mean = mean_scores(by_name.values())
    return {
        "tracker": tracker,
        "dataset": dataset,
        "convention": convention,
        **mean.figures,
        "invalid_rows": mean.invalid,
        "sequences": {name: scores.figures for name, scores in by_name.items()},
        "fps": fps,
    }

"""The long-term F-score, on frames counted by hand."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest


@pytest.fixture(scope="module")
def table() -> Callable[..., dict[str, Any]]:
    path = Path(__file__).parents[2] / "benchmarks" / "after_loss.py"
    spec = importlib.util.spec_from_file_location("after_loss", path)
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script.table


def test_the_f_score_is_the_best_over_all_limits(table: Callable[..., dict[str, Any]]) -> None:
    # overlap, in sight, score: followed, followed, out of sight with a low score, in sight and missed with a low score
    clip = np.array([[0.8, 1, 0.9], [0.6, 1, 0.8], [0.0, 0, 0.2], [0.0, 1, 0.1]])
    found = table([clip], curve=False)
    # the limit that keeps the first two: precision (0.8 + 0.6) / 2, recall (0.8 + 0.6) / 3
    assert found["precision"] == pytest.approx(0.7, abs=1e-3)
    assert found["recall"] == found["recall_of_all"] == pytest.approx(1.4 / 3, abs=1e-3)
    assert found["f"] == pytest.approx(2 * 0.7 * 1.4 / 3 / (0.7 + 1.4 / 3), abs=1e-3)


def test_clips_weigh_the_same_whatever_their_length(table: Callable[..., dict[str, Any]]) -> None:
    short, long = np.array([[1.0, 1, 0.5]]), np.array([[0.0, 1, 0.5]] * 9)
    assert table([short, long], curve=True)["recall"] == pytest.approx(0.5)

"""The long-term F-score, on frames counted by hand."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from psiamfcpp.errors import UserError


def test_the_f_score_is_the_best_over_all_limits(script: ModuleType) -> None:
    # overlap, in sight, score: followed, followed, out of sight with a low score, in sight and missed with a low score
    clip = np.array([[0.8, 1, 0.9, 1, 5], [0.6, 1, 0.8, 1, 5], [0.0, 0, 0.2, 1, 5], [0.0, 1, 0.1, 1, 5]])
    found = script.table([clip])
    # the limit that keeps the first two: precision (0.8 + 0.6) / 2, recall (0.8 + 0.6) / 3
    assert found["precision"] == pytest.approx(0.7, abs=1e-3)
    assert found["recall"] == found["recall_of_all"] == pytest.approx(1.4 / 3, abs=1e-3)
    assert found["f"] == pytest.approx(2 * 0.7 * 1.4 / 3 / (0.7 + 1.4 / 3), abs=1e-3)


def test_clips_weigh_the_same_whatever_their_length(script: ModuleType) -> None:
    short, long = np.array([[1.0, 1, 0.5, 1, 5]]), np.array([[0.0, 1, 0.5, 1, 5]] * 9)
    assert script.table([short, long])["recall"] == pytest.approx(0.5)


def test_the_curve_is_drawn(script: ModuleType, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    clip = np.array([[0.8, 1, 0.9, 1, 5], [0.0, 0, 0.2, 1, 5], [0.6, 1, 0.1, 1, 5]])
    image = tmp_path / "curve.png"
    script.draw({"mine states": [clip], "mine plain": [clip]}, image)
    assert image.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(UserError, match=r"folder .*missing is not there"):
        script.main(("mine",), seeds=(1,), curve=tmp_path / "missing" / "curve.png")


def test_times_of_sure_and_other_frames_stand_apart(script: ModuleType) -> None:
    clip = np.array([[0.8, 1, 0.9, sure, ms] for sure, ms in ((1, 4.0), (1, 5.0), (1, 9.0), (0, 8.0), (0, 10.0))])
    assert script.times(clip) == {"ms_sure": 5.0, "ms_unsure": 9.0, "worst": 2.0}
    assert script.times(clip[:3]) == {"ms_sure": 5.0}

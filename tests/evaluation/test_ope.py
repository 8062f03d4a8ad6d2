"""One pass over a sequence on disk."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psiamfcpp import Tracker, UserError, datasets
from psiamfcpp.evaluation.metrics import score_sequence
from psiamfcpp.evaluation.ope import one_pass

BOXES = [(100.0 + 3 * t, 80.0 + t, 40.0, 30.0) for t in range(6)]


def test_one_pass_gives_a_row_a_frame(blob_engine: Any, blob_sequence: Callable[..., Path]) -> None:
    (sequence,) = datasets.read("folder", blob_sequence("car1", BOXES))
    run = one_pass(Tracker(), sequence)
    assert run.boxes.shape == (6, 4)
    assert run.scores.shape == run.seconds.shape == (6,)
    assert run.boxes[0] == pytest.approx(BOXES[0])
    assert run.scores[0] == 1
    assert run.states == ["tracking"] * 6
    assert (run.seconds > 0).all()
    assert score_sequence(sequence.boxes, run.boxes).precision_curve[2] == 1
    # the template was taken once: later labels are not looked at
    assert len(blob_engine.templates) == 1


def test_a_tracker_serves_one_sequence_after_the_other(blob_engine: Any, blob_sequence: Callable[..., Path]) -> None:
    blob_sequence("car1", BOXES)
    root = blob_sequence("car2", [(x + 90, y - 40, w, h) for x, y, w, h in BOXES])
    tracker = Tracker()
    for sequence in datasets.read("folder", root):
        assert one_pass(tracker, sequence).boxes == pytest.approx(sequence.boxes, abs=1)


def test_a_damaged_frame_is_named(blob_engine: Any, blob_sequence: Callable[..., Path]) -> None:
    (sequence,) = datasets.read("folder", blob_sequence("car1", BOXES))
    sequence.frames[3].write_bytes(b"no image")
    with pytest.raises(UserError, match=r"0004\.png cannot be read"):
        one_pass(Tracker(), sequence)


def test_a_sequence_whose_first_label_is_missing_is_refused(
    blob_engine: Any, blob_sequence: Callable[..., Path]
) -> None:
    (sequence,) = datasets.read("folder", blob_sequence("car1", BOXES))
    sequence.boxes[0] = np.nan
    with pytest.raises(UserError, match="box nan,nan,nan,nan"):
        one_pass(Tracker(), sequence)

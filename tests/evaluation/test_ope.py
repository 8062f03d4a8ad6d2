"""One pass over a sequence on disk."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psiamfcpp import UserError, datasets
from psiamfcpp.evaluation.metrics import score_sequence
from psiamfcpp.evaluation.ope import one_pass
from psiamfcpp.trackers import choose

BOXES = [(100.0 + 3 * t, 80.0 + t, 40.0, 30.0) for t in range(6)]


def test_one_pass_gives_a_row_a_frame(blob_engine: Any, blob_sequence: Callable[..., Path]) -> None:
    (sequence,) = datasets.read("folder", blob_sequence("car1", BOXES))
    run = one_pass(choose("blob").open(), sequence)
    assert run.boxes.shape == (6, 4)
    assert run.seconds.shape == run.decoding.shape == (6,)
    assert run.boxes[0] == pytest.approx(BOXES[0])
    assert (run.seconds > 0).all()
    assert (run.decoding > 0).all()
    assert score_sequence(sequence.boxes, run.boxes).precision_curve[2] == 1
    # the template was taken once: later labels are not looked at
    assert len(blob_engine.templates) == 1


def test_a_tracker_serves_one_sequence_after_the_other(blob_engine: Any, blob_sequence: Callable[..., Path]) -> None:
    blob_sequence("car1", BOXES)
    root = blob_sequence("car2", [(x + 90, y - 40, w, h) for x, y, w, h in BOXES])
    tracker = choose("blob").open()
    for sequence in datasets.read("folder", root):
        assert one_pass(tracker, sequence).boxes == pytest.approx(sequence.boxes, abs=1)


def test_a_damaged_frame_is_named(blob_engine: Any, blob_sequence: Callable[..., Path]) -> None:
    (sequence,) = datasets.read("folder", blob_sequence("car1", BOXES))
    sequence.frames[3].write_bytes(b"no image")
    with pytest.raises(UserError, match=r"0004\.png cannot be read"):
        one_pass(choose("blob").open(), sequence)


@pytest.mark.parametrize("unusable", [np.nan, 0, -5, np.inf])
def test_it_begins_at_the_first_label_that_is_one(
    blob_engine: Any, blob_sequence: Callable[..., Path], unusable: float
) -> None:
    (sequence,) = datasets.read("folder", blob_sequence("car1", BOXES))
    sequence.boxes[0] = np.nan
    sequence.boxes[1, 2] = unusable
    run = one_pass(choose("blob").open(), sequence)
    assert np.isnan(run.boxes[:2]).all()
    assert np.isnan(run.seconds).tolist() == np.isnan(run.decoding).tolist() == [True] * 2 + [False] * 4
    assert run.boxes[2:] == pytest.approx(sequence.boxes[2:], abs=1)
    # the rows before the start count as the convention says of rows without a label
    assert score_sequence(sequence.boxes, run.boxes, "otb").figures["success50"] == pytest.approx(4 / 6)
    sequence.boxes[1] = np.nan
    assert score_sequence(sequence.boxes, run.boxes, "got10k").figures["success50"] == 1


def test_a_sequence_without_any_label_is_refused(blob_engine: Any, blob_sequence: Callable[..., Path]) -> None:
    (sequence,) = datasets.read("folder", blob_sequence("car1", BOXES))
    sequence.boxes[:] = np.nan
    with pytest.raises(UserError, match="no label is a box that a tracker can begin with"):
        one_pass(choose("blob").open(), sequence)


def test_a_sequence_of_one_frame(blob_engine: Any, blob_sequence: Callable[..., Path]) -> None:
    (sequence,) = datasets.read("folder", blob_sequence("car1", BOXES[:1]))
    assert one_pass(choose("blob").open(), sequence).boxes.tolist() == [list(BOXES[0])]

"""Each shipped int8 model on fifteen UAV sequences, against what its card says of them."""

from __future__ import annotations

import functools
import re
from pathlib import Path

import numpy as np
import pytest
from joblib import Parallel, delayed

from psiamfcpp import datasets, zoo
from psiamfcpp.datasets import Sequence
from psiamfcpp.evaluation.metrics import Scores, mean_scores, score_sequence
from psiamfcpp.evaluation.ope import first_label
from psiamfcpp.images import ImageReader
from psiamfcpp.trackers import Tracker, TrackerOptions, open_tracker

FOLDER = Path(zoo.__file__).parent
INT8 = [name for name in zoo.graph_names() if name.endswith("-int8")]
_BELOW = 0.02
_HEADING = "## Fifteen sequences"
_ROW = re.compile(r"\| `(?P<model>[\w-]+)(?P<plain> --plain)?` \| (?P<precision>[01]\.\d+) \| (?P<auc>[01]\.\d+) \|")


def on_the_card(name: str) -> dict[bool, tuple[float, float]]:
    """Precision and AUC by whether the procedure is plain, from the table in a model's card."""
    card = (FOLDER / f"{name.removesuffix('-int8')}.md").read_text()
    section = card.partition(_HEADING)[2].partition("\n## ")[0]
    rows = (row for row in _ROW.finditer(section) if row["model"] == name)
    return {bool(row["plain"]): (float(row["precision"]), float(row["auc"])) for row in rows}


@pytest.mark.parametrize("name", INT8)
def test_a_card_with_the_table_has_both_procedures(name: str) -> None:
    if _HEADING not in (FOLDER / f"{name.removesuffix('-int8')}.md").read_text():
        pytest.skip(f"the card of {name} has no table of the fifteen yet")
    stated = on_the_card(name)
    assert set(stated) == {False, True}
    assert all(0.3 < auc < precision < 1 for precision, auc in stated.values())


@functools.cache
def opened(name: str) -> Tracker:
    """A tracker, opened once per process."""
    return open_tracker(name, TrackerOptions(threads=1))


def follow_all(names: list[str], sequence: Sequence) -> dict[str, Scores]:
    """One pass of each model over a sequence, all on the same decoded frames."""
    trackers = {name: opened(name) for name in names}
    start, images = first_label(sequence), ImageReader()
    boxes = {name: np.full((len(sequence), 4), np.nan) for name in names}
    for number in range(start, len(sequence)):
        frame = sequence.frame(number, images)
        for name, tracker in trackers.items():
            if number == start:
                tracker.init(frame, sequence.boxes[number])
                boxes[name][number] = sequence.boxes[number]
            else:
                boxes[name][number] = tracker.update(frame).box
    return {name: score_sequence(sequence.boxes, found) for name, found in boxes.items()}


@pytest.fixture(scope="module")
def measured(shared_data: Path) -> dict[str, dict[str, float]]:
    """Mean figures over the fifteen of each model whose card has the table; sequences in two processes."""
    roots = [shared_data / "uav", shared_data / "uav-video"]
    missing = [root for root in roots if not root.is_dir()]
    if missing:
        pytest.skip(f"{missing[0]} is not there: it holds a part of the fifteen sequences")
    sequences = [sequence for root in roots for sequence in datasets.read("folder", root)]
    assert len(sequences) == 15
    names = [name for name in INT8 if False in on_the_card(name)]
    # The longest first, so that neither process waits long for the other at the end.
    longest_first = sorted(sequences, key=len, reverse=True)
    scores = Parallel(n_jobs=2, batch_size=1)(delayed(follow_all)(names, sequence) for sequence in longest_first)
    return {name: mean_scores(score[name] for score in scores).figures for name in names}


@pytest.mark.slow
@pytest.mark.benchmark
@pytest.mark.parametrize("name", INT8)
def test_the_default_path_does_what_its_card_says(name: str, measured: dict[str, dict[str, float]]) -> None:
    if name not in measured:
        pytest.skip(f"the card of {name} has no table of the fifteen yet")
    precision, auc = on_the_card(name)[False]
    assert measured[name]["precision"] >= precision - _BELOW
    assert measured[name]["auc"] >= auc - _BELOW

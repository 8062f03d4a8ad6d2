"""Each shipped int8 model on fifteen UAV sequences, against what its card says of them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from psiamfcpp import datasets, zoo
from psiamfcpp.evaluation.ope import mean_over
from psiamfcpp.trackers import TrackerOptions, open_tracker

FOLDER = Path(zoo.__file__).parent
INT8 = [name for name in zoo.graph_names() if name.endswith("-int8")]
# Roundings that differ by processor move a mean less than this.
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


@pytest.mark.slow
@pytest.mark.parametrize("name", INT8)
def test_the_default_path_does_what_its_card_says(name: str, shared_data: Path) -> None:
    if False not in on_the_card(name):
        pytest.skip(f"the card of {name} has no table of the fifteen yet")
    roots = [shared_data / "uav", shared_data / "uav-video"]
    missing = [root for root in roots if not root.is_dir()]
    if missing:
        pytest.skip(f"{missing[0]} is not there: it holds a part of the fifteen sequences")
    sequences = [sequence for root in roots for sequence in datasets.read("folder", root)]
    assert len(sequences) == 15
    tracker = open_tracker(name, TrackerOptions(threads=1))
    found, (precision, auc) = mean_over(tracker, sequences).figures, on_the_card(name)[False]
    assert found["precision"] >= precision - _BELOW
    assert found["auc"] >= auc - _BELOW

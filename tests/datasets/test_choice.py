from __future__ import annotations

import pytest

from psiamfcpp.datasets.choice import DataChoice
from psiamfcpp.errors import UserError


@pytest.fixture
def entries(lay) -> tuple[str, ...]:
    """Seven clips and one photograph in two data sets."""
    clips = {f"clips/car{i}/groundtruth_rect.txt": "1,2,3,4\n" * 2 for i in range(1, 8)}
    frames = tuple(f"clips/car{i}/img/{k}.jpg" for i in range(1, 8) for k in (1, 2))
    root = lay({**clips, "photos/boxes.csv": "image,x,y,w,h,label,source\na.jpg,1,2,3,4,car,web\n"}, frames)
    return (f"folder:{root / 'clips'}", f"stills:{root / 'photos'}")


@pytest.mark.parametrize(
    ("every", "held_out"),
    # CRC-32 of car1 is 219495848 and that of car3 is 3810221188; those of the others are no multiples of 4.
    [(4, {"car1", "car3"}), (0, set()), (1, {f"car{i}" for i in range(1, 8)})],
)
def test_every_sequence_is_on_one_side(entries: tuple[str, ...], every: int, held_out: set[str]):
    choice = DataChoice(entries, every)
    assert {s.name for s in choice.held_out} == held_out
    everything = {f"car{i}" for i in range(1, 8)} | {"a.jpg#2"}
    assert {s.name for s in choice.training} == everything - held_out
    assert choice.named == ["folder:clips", "stills:photos"]


def test_nothing_is_held_out_unless_asked_for(entries: tuple[str, ...]):
    assert DataChoice(entries).held_out == []


@pytest.mark.parametrize(
    ("entry", "fault"), [("clips", "is not LAYOUT:FOLDER"), ("voc:clips", "unknown dataset layout 'voc'")]
)
def test_data_that_cannot_be_read(entry: str, fault: str):
    with pytest.raises(UserError, match=fault):
        _ = DataChoice((entry,)).training


def test_a_negative_share_is_refused(entries: tuple[str, ...]):
    with pytest.raises(UserError, match="held-out-every is -2: it must be 0 or more"):
        DataChoice(entries, -2)

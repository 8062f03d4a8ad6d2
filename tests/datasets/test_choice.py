from __future__ import annotations

import cv2
import numpy as np
import pytest

from psiamfcpp.datasets.choice import DataChoice
from psiamfcpp.errors import UserError


@pytest.fixture
def entries(lay) -> tuple[str, ...]:
    """Seven clips and one photograph in two data sets."""
    clips = {f"clips/car{i}/groundtruth_rect.txt": "1,2,3,4\n" * 2 for i in range(1, 8)}
    frames = tuple(f"clips/car{i}/img/{k}.jpg" for i in range(1, 8) for k in (1, 2))
    root = lay(
        {**clips, "photos/boxes.csv": "image,x,y,w,h,label,source\na.jpg,1,2,3,4,car,web\n"},
        (*frames, "photos/images/a.jpg"),
    )
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


def test_what_holds_out_everything_is_named(entries: tuple[str, ...]):
    choice = DataChoice(entries[:1], 1)
    with pytest.raises(UserError, match=r"--held-out-every 1 holds out car1, car2, car3 \.\.\.: give more clips, or 0"):
        _ = choice.training
    assert len(choice.held_out) == 7


def test_nothing_is_held_out_unless_asked_for(entries: tuple[str, ...]):
    assert DataChoice(entries).held_out == []


def test_what_cannot_be_read_is_left_out_and_named(lay):
    files = {
        "a/groundtruth_rect.txt": "1,2,3,4\n" * 2,
        "b/groundtruth_rect.txt": "1,2,3,4\n" * 3,
        "c/groundtruth_rect.txt": "1,2,three\n",
    }
    root = lay(files, tuple(f"{name}/img/{number}.png" for name in "abc" for number in (1, 2)))
    cv2.imwrite(str(root / "a/img/1.png"), np.zeros((8, 8, 3), np.uint8))
    choice = DataChoice((f"folder:{root}",), skip_bad=True)
    (only,) = choice.training
    assert (only.name, only.usable().tolist()) == ("a", [0])
    notes: list[str] = []
    choice.note_left_out(notes.append)
    assert notes[0] == "3 rows, images or sequences of the data are left out:"
    assert "b has 2 images but 3 boxes" in notes[1]
    assert "line 1 is '1,2,three'" in notes[2]
    assert notes[3] == f"  image {root}/a/img/2.png cannot be read"
    with pytest.raises(UserError, match="b has 2 images but 3 boxes"):
        _ = DataChoice((f"folder:{root}",)).training


def test_of_many_left_out_the_first_are_named(lay):
    rows = "".join(f"{number}.jpg,1,2,3,4,car,web\n" for number in range(50))
    root = lay({"boxes.csv": "image,x,y,w,h,label,source\n" + rows}, ("images/7.jpg",))
    notes: list[str] = []
    DataChoice((f"stills:{root}",), skip_bad=True).note_left_out(notes.append)
    assert (len(notes), notes[0].split()[0], notes[-1]) == (22, "50", "  and 30 more")


@pytest.mark.parametrize(
    ("entry", "fault"), [("clips", "is not LAYOUT:FOLDER"), ("voc:clips", "unknown dataset layout 'voc'")]
)
def test_data_that_cannot_be_read(entry: str, fault: str):
    with pytest.raises(UserError, match=fault):
        _ = DataChoice((entry,)).training


def test_a_negative_share_is_refused(entries: tuple[str, ...]):
    with pytest.raises(UserError, match="held-out-every is -2: it must be 0 or more"):
        DataChoice(entries, -2)

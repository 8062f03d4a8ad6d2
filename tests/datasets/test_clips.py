from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from psiamfcpp.datasets import clips
from psiamfcpp.errors import UserError

from .conftest import level, write_video

HEAD = "clip,frame,track,x,y,w,h\n"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_video(tmp_path / "car_0.mp4", 4)
    write_video(tmp_path / "boat3.mp4", 3, start=6)
    return tmp_path


def test_a_sequence_a_track(root: Path):
    (root / "boxes.csv").write_text(
        HEAD + "car_0,0,a,1,2,3,4\nboat3,2,0,5,5,5,5\ncar_0,2,a,2,2,3,4\ncar_0,1,b,9,9,8,8\n"
    )
    first, boat, second = clips.read(root)
    assert [(s.name, s.clip, s.source, len(s)) for s in (first, boat, second)] == [
        ("car_0_ta", "car_0", "car", 4),
        ("boat3_t0", "boat3", "boat", 3),
        ("car_0_tb", "car_0", "car", 4),
    ]
    nothing = [np.nan] * 4
    np.testing.assert_equal(first.boxes, [[1, 2, 3, 4], nothing, [2, 2, 3, 4], nothing])
    np.testing.assert_equal(second.boxes, [nothing, [9, 9, 8, 8], nothing, nothing])
    assert [level(first.frame(i)) for i in (2, 0)] == [2, 0]
    assert level(boat.frame(1)) == 7
    assert first.frames == second.frames


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD + "car_0,0,a,1,2,3,4\ncar_0,one,a,1,2,3,4\n", r"boxes\.csv line 3 is not a labelled box .*<root>/"),
        (HEAD + "car_0,0,a,1,2,3\n", r"boxes\.csv line 2 is not a labelled box"),
        ("clip,frame,x,y,w,h\ncar_0,0,1,2,3,4\n", r"boxes\.csv line 2 is not a labelled box \('track'\)"),
        (HEAD + "car_0,4,a,1,2,3,4\n", "clip car_0 has 4 frames, but a box in frame 4"),
        (HEAD + "car_0,-1,a,1,2,3,4\n", "clip car_0 has 4 frames, but a box in frame -1"),
        (HEAD + "train,0,a,1,2,3,4\n", r"train\.mp4 is missing; expected layout: <root>/"),
    ],
)
def test_tables_that_cannot_be_used(root: Path, text: str, message: str):
    (root / "boxes.csv").write_text(text)
    with pytest.raises(UserError, match=message):
        clips.read(root)


def test_odd_rows_and_clips_can_be_left_out(root: Path):
    rows = "car_0,0,a,1,2,3,4\ncar_0,one,a,1,2,3,4\ntrain,0,a,1,2,3,4\nboat3,9,a,1,2,3,4\n"
    (root / "boxes.csv").write_text(HEAD + rows)
    left_out: list[str] = []
    assert [s.name for s in clips.read(root, left_out)] == ["car_0_ta"]
    assert len(left_out) == 3


def test_a_clip_whose_length_cannot_be_true(root: Path):
    content = (root / "car_0.mp4").read_bytes()
    at = content.index(b"stts") + 12  # where the number of frames of one length stands
    (root / "car_0.mp4").write_bytes(content[:at] + b"\x7f\xff\xff\xff" + content[at + 4 :])
    (root / "boxes.csv").write_text(HEAD + "car_0,0,a,1,2,3,4\n")
    with pytest.raises(UserError, match=r"car_0\.mp4 (is damaged|cannot be read)"):
        clips.read(root)

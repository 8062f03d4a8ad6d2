from __future__ import annotations

import pytest

from psiamfcpp.datasets import BENCHMARKS
from psiamfcpp.errors import UserError

UAVDT = BENCHMARKS["uavdt"]
TEXTS = {"anno/S0101_gt.txt": "1,0,3,4\n5,6,7,8\n", "anno/S0101_att.txt": "0,1,0\n"}
FRAMES = ("sequences/S0101/img000002.jpg", "sequences/S0101/img000001.jpg")


def test_labels_and_frames_are_brought_together(lay):
    (sequence,) = UAVDT.read(lay(TEXTS, FRAMES))
    assert sequence.name == "S0101"
    assert [p.name for p in sequence.frames] == ["img000001.jpg", "img000002.jpg"]
    assert sequence.boxes.tolist() == [[1, 0, 3, 4], [5, 6, 7, 8]]


@pytest.mark.parametrize("part", ["", "anno"])
def test_labels_alone(lay, part: str):
    assert list(UAVDT.read_labels(lay(TEXTS) / part)) == ["S0101"]


def test_missing_frames(lay):
    with pytest.raises(UserError, match="sequences/S0101 is missing; expected layout: <root>/sequences"):
        UAVDT.read(lay(TEXTS))
    with pytest.raises(UserError, match="S0101 has 1 images but 2 boxes"):
        UAVDT.read(lay(TEXTS, FRAMES[:1]))

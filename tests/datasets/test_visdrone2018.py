from __future__ import annotations

import pytest

from psiamfcpp.datasets import BENCHMARKS
from psiamfcpp.errors import UserError

VISDRONE = BENCHMARKS["visdrone2018"]
NAME = "uav0000074_04320_s"
TEXTS = {f"annotations/{NAME}.txt": "1,2,3,4\n", f"attributes/{NAME}_attr.txt": "0,1\n"}


def test_labels_and_frames_are_brought_together(lay):
    root = lay(TEXTS, (f"sequences/{NAME}/img0000001.jpg",))
    (sequence,) = VISDRONE.read(root)
    assert (sequence.name, sequence.frames[0].name, sequence.boxes.tolist()) == (NAME, "img0000001.jpg", [[1, 2, 3, 4]])
    assert list(VISDRONE.read_labels(root)) == list(VISDRONE.read_labels(root / "annotations")) == [NAME]


def test_missing_frames(lay):
    with pytest.raises(UserError, match=f"sequences/{NAME} is missing; expected layout"):
        VISDRONE.read(lay(TEXTS))

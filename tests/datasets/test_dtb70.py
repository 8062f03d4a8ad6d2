from __future__ import annotations

import pytest

from psiamfcpp.datasets import BENCHMARKS
from psiamfcpp.errors import UserError

DTB70 = BENCHMARKS["dtb70"]
FRAMES = ("Car6/img/00002.jpg", "Car6/img/00001.jpg", "Animal1/img/00001.jpg")
TEXTS = {"Car6/groundtruth_rect.txt": "1,2,3,4\n0,0,0,0\n", "Animal1/groundtruth_rect.txt": "5,6,7,8\n"}


def test_sequences_by_name_with_their_zero_rows(lay):
    root = lay(TEXTS, FRAMES)
    animal, car = DTB70.read(root)
    assert (animal.name, car.name) == ("Animal1", "Car6")
    assert [p.name for p in car.frames] == ["00001.jpg", "00002.jpg"]
    assert car.boxes.tolist() == [[1, 2, 3, 4], [0, 0, 0, 0]]
    assert DTB70.read_labels(root)["Car6"].tolist() == car.boxes.tolist()


def test_frames_and_labels_must_agree(lay):
    with pytest.raises(UserError, match="Car6 has 1 images but 2 boxes"):
        DTB70.read(lay(TEXTS, FRAMES[1:]))
    with pytest.raises(UserError, match=r"Aa/img is missing; expected layout: <root>"):
        DTB70.read(lay({"Aa/groundtruth_rect.txt": "1,2,3,4\n"}))

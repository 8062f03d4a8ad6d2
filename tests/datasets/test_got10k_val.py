from __future__ import annotations

import pytest

from psiamfcpp.datasets import BENCHMARKS
from psiamfcpp.errors import UserError

VAL = BENCHMARKS["got10k-val"]
NAMES = ("GOT-10k_Val_000002", "GOT-10k_Val_000001")


def files(*names: str) -> dict[str, str]:
    texts = {"val/list.txt": "\n".join(NAMES), "train/list.txt": "GOT-10k_Train_000001\n"}
    for name in names:
        # absence.label would take the second box from a training set
        texts |= {f"val/{name}/groundtruth.txt": "1,2,3,4\n0,0,0,0\n", f"val/{name}/absence.label": "0\n1\n"}
        texts |= {f"val/{name}/0000000{i}.jpg": "" for i in (2, 1)}
    return texts


@pytest.mark.parametrize("part", ["", "val"])
def test_the_split_in_the_order_of_its_list_with_all_its_labels(lay, part: str):
    root = lay(files(*NAMES)) / part
    sequences = VAL.read(root)
    assert tuple(s.name for s in sequences) == NAMES == tuple(VAL.read_labels(root))
    assert [p.name for p in sequences[0].frames] == ["00000001.jpg", "00000002.jpg"]
    assert sequences[0].boxes.tolist() == [[1, 2, 3, 4], [0, 0, 0, 0]]


def test_a_listed_sequence_that_is_missing(lay):
    with pytest.raises(UserError, match=r"GOT-10k_Val_000001/groundtruth\.txt is missing; expected layout"):
        VAL.read(lay(files(NAMES[0])))


def test_a_sequence_that_is_missing_can_be_left_out_by_name(lay):
    root, left_out = lay(files(NAMES[0])), dict[str, str]()
    assert [s.name for s in VAL.read(root, left_out)] == [NAMES[0]]
    assert list(left_out) == [NAMES[1]]
    assert "is missing" in left_out[NAMES[1]]
    labels: dict[str, str] = {}
    assert list(VAL.read_labels(root, labels)) == [NAMES[0]]
    assert list(labels) == [NAMES[1]]

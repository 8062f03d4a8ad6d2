from __future__ import annotations

import pytest

from psiamfcpp.datasets import BENCHMARKS
from psiamfcpp.errors import UserError

OTB100 = BENCHMARKS["otb100"]


def images(folder: str, first: int, last: int, digits: int = 4) -> tuple[str, ...]:
    return tuple(f"{folder}/img/{i:0{digits}d}.jpg" for i in range(first, last + 1))


@pytest.mark.parametrize(
    ("name", "there", "digits", "used"),
    [
        ("Car4", (1, 3), 4, (1, 3)),
        ("Board", (1, 3), 5, (1, 3)),  # five digits in a name
        ("David", (1, 305), 4, (300, 302)),  # labelled from frame 300 on
        ("BlurCar1", (247, 249), 4, (247, 249)),  # its first file is 0247.jpg
        ("BlurCar3", (3, 5), 4, (3, 5)),
        ("BlurCar4", (18, 20), 4, (18, 20)),
        ("Football1", (1, 9), 4, (1, 3)),  # more frames than labels
    ],
)
def test_frames_that_the_labels_are_of(
    lay, name: str, there: tuple[int, int], digits: int, used: tuple[int, int]
) -> None:
    root = lay({f"{name}/groundtruth_rect.txt": "1\t2\t3\t4\n" * 3}, images(name, *there, digits))
    (sequence,) = OTB100.read(root)
    assert sequence.name == name
    assert sequence.frames == [root / path for path in images(name, *used, digits)]
    assert sequence.boxes.tolist() == [[1, 2, 3, 4]] * 3


@pytest.mark.parametrize("first", ["", "1,2,3,4\n"])
def test_two_targets_are_two_sequences(lay, first: str):
    texts = {
        "Jogging/groundtruth_rect.1.txt": "1,2,3,4\n",
        "Jogging/groundtruth_rect.2.txt": "5,6,7,8\n",
        "Human4/groundtruth_rect.1.txt": first,
        "Human4/groundtruth_rect.2.txt": "9,9,9,9\n",
    }
    root = lay(texts, images("Jogging", 1, 1) + images("Human4", 1, 1))
    human, one, two = OTB100.read(root)
    assert (human.name, one.name, two.name) == ("Human4-2", "Jogging-1", "Jogging-2")
    assert (one.boxes.tolist(), two.boxes.tolist()) == ([[1, 2, 3, 4]], [[5, 6, 7, 8]])
    assert one.frames == two.frames
    assert list(OTB100.read_labels(root)) == ["Human4-2", "Jogging-1", "Jogging-2"]


def test_a_missing_frame_is_named(lay):
    root = lay({"Car4/groundtruth_rect.txt": "1,2,3,4\n" * 3}, (*images("Car4", 1, 1), *images("Car4", 3, 3)))
    with pytest.raises(UserError, match=r"Car4 has 3 boxes, from frame 1 on, but .*Car4/img has no frame 2"):
        OTB100.read(root)


@pytest.mark.parametrize("rows", [354, 349])
def test_tiger1_is_counted_from_its_sixth_frame(lay, rows: int):
    text = "".join(f"{number},2,3,4\n" for number in range(355 - rows, 355))
    root = lay({"Tiger1/groundtruth_rect.txt": text}, images("Tiger1", 1, 354))
    (sequence,) = OTB100.read(root)
    assert (sequence.frames[0].name, sequence.frames[-1].name) == ("0006.jpg", "0354.jpg")
    assert (sequence.boxes[0, 0], len(sequence.boxes)) == (6, 349)
    assert (OTB100.read_labels(root)["Tiger1"] == sequence.boxes).all()

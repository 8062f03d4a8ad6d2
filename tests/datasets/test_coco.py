from __future__ import annotations

import json

import pytest

from psiamfcpp.datasets import coco
from psiamfcpp.errors import UserError

TRAIN = "annotations/instances_train2017.json"


def table(**changes: object) -> dict:
    """Two images and two objects that count, besides a crowd and an empty box."""
    annotations = [
        {"id": 11, "image_id": 2, "category_id": 3, "bbox": [1.5, 2, 3, 4], "iscrowd": 0},
        {"id": 12, "image_id": 1, "category_id": 1, "bbox": [0, 0, 5, 6]},
        {"id": 13, "image_id": 1, "category_id": 1, "bbox": [0, 0, 9, 9], "iscrowd": 1},
        {"id": 14, "image_id": 1, "category_id": 1, "bbox": [3, 3, 0, 9], "iscrowd": 0},
    ]
    return {
        "images": [{"id": 1, "file_name": "000001.jpg"}, {"id": 2, "file_name": "000002.jpg"}],
        "categories": [{"id": 1, "name": "person"}, {"id": 3, "name": "car"}],
        "annotations": annotations,
    } | changes


def test_one_sequence_an_object(lay):
    root = lay({TRAIN: json.dumps(table())}, empty=("train2017/000001.jpg", "train2017/000002.jpg"))
    car, person = coco.read(root)
    assert (car.name, car.source) == ("train2017/000002#11", "car")
    assert (person.name, person.source) == ("train2017/000001#12", "person")
    assert car.frames == [root / "train2017/000002.jpg"]
    assert car.boxes.tolist() == [[1.5, 2, 3, 4]]
    assert person.boxes.tolist() == [[0, 0, 5, 6]]


def test_both_parts(lay):
    texts = {f"annotations/instances_{part}2017.json": json.dumps(table()) for part in ("val", "train")}
    images = tuple(f"{part}2017/00000{i}.jpg" for part in ("train", "val") for i in (1, 2))
    names = [s.name.split("/")[0] for s in coco.read(lay(texts, empty=images))]
    assert names == ["train2017", "train2017", "val2017", "val2017"]


def test_missing_image_folder_shows_the_layout(lay):
    with pytest.raises(UserError, match="train2017 is missing; expected layout: <root>"):
        coco.read(lay({TRAIN: json.dumps(table())}))


def test_missing_image_is_named(lay):
    root = lay({TRAIN: json.dumps(table())}, empty=("train2017/000001.jpg",))
    with pytest.raises(UserError, match=r"train2017/000002\.jpg is missing"):
        coco.read(root)


def box(value: object) -> list[dict]:
    return [{"id": 1, "image_id": 1, "category_id": 1, "bbox": value}]


@pytest.mark.parametrize(
    "text",
    [
        "{ cut off",
        "[]",
        json.dumps({"images": []}),
        json.dumps(table(images=[])),
        json.dumps(table(categories=[])),
        json.dumps(table(annotations=box([1, 2, 3]))),
        json.dumps(table(annotations=box(["a", 2, 3, 4]))),
        json.dumps(table(annotations=box(None))),
        json.dumps(table(annotations=["junk"])),
    ],
)
def test_junk_annotations(lay, text: str):
    root = lay({TRAIN: text}, empty=("train2017/000001.jpg",))
    with pytest.raises(UserError, match=r"instances_train2017\.json are not COCO instances") as caught:
        coco.read(root)
    assert "\n" not in str(caught.value)

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
    with pytest.raises(
        UserError, match=r"train2017/000002\.jpg does not exist, which .*instances_train2017\.json names"
    ):
        coco.read(root)


@pytest.mark.parametrize(
    ("annotations", "image"),
    [
        ([{"id": 2, "image_id": 1, "category_id": 1, "bbox": []}], "1.jpg"),
        ([{"id": 2, "image_id": 1, "category_id": 1, "bbox": None}], "1.jpg"),
        ([{"id": 2, "image_id": 1, "category_id": 1}], "1.jpg"),
        ([{"id": 2, "image_id": 7, "category_id": 1, "bbox": [1, 2, 3, 4]}], "1.jpg"),
        ([], "sub/1.jpg"),
    ],
    ids=["empty", "null", "no box", "image not listed", "folder"],
)
def test_objects_without_a_box_are_left_out_and_images_may_lie_in_folders(lay, annotations: list[dict], image: str):
    good = {"id": 1, "image_id": 1, "category_id": 1, "bbox": [10, 10, 20, 20], "iscrowd": 0}
    content = table(images=[{"id": 1, "file_name": image}], annotations=[good, *annotations])
    root = lay({TRAIN: json.dumps(content)}, empty=(f"train2017/{image}",))
    (only,) = coco.read(root)
    assert only.frames == [root / "train2017" / image]
    assert only.name == f"train2017/{image.removesuffix('.jpg')}#1"


def test_a_set_without_any_object_is_refused(lay):
    root = lay({TRAIN: json.dumps(table(annotations=[]))}, empty=("train2017/000001.jpg",))
    with pytest.raises(UserError, match="of no object with a box and an image"):
        coco.read(root)


def test_what_is_cut_off_is_no_json(lay):
    with pytest.raises(UserError, match=r"instances_train2017\.json is not JSON .*fetch them again"):
        coco.read(lay({TRAIN: "{ cut off"}, empty=("train2017/000001.jpg",)))


@pytest.mark.parametrize("bbox", ["[1, 2, 3]", "[1, 2, Infinity, 4]", "[1, 2, 1e999, 4]", '["a", 2, 3, 4]', "true"])
def test_an_odd_annotation_is_named_and_can_be_left_out(lay, bbox: str):
    odd = {"id": 77, "image_id": 2, "category_id": 3, "bbox": "BOX"}
    text = json.dumps(table(annotations=[*table()["annotations"], odd])).replace('"BOX"', bbox)
    root = lay({TRAIN: text}, empty=("train2017/000001.jpg", "train2017/000002.jpg"))
    with pytest.raises(UserError, match=r"not COCO instances \(annotation 77: "):
        coco.read(root)
    left_out: list[str] = []
    assert len(coco.read(root, left_out)) == 2
    assert len(left_out) == 1
    assert "annotation 77" in left_out[0]


def box(value: object) -> list[dict]:
    return [{"id": 1, "image_id": 1, "category_id": 1, "bbox": value}]


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        json.dumps({"images": []}),
        json.dumps(table(categories=[])),
        json.dumps(table(annotations=box([1, 2, 3]))),
        json.dumps(table(annotations=box(["a", 2, 3, 4]))),
        json.dumps(table(annotations=["junk"])),
    ],
)
def test_junk_annotations(lay, text: str):
    root = lay({TRAIN: text}, empty=("train2017/000001.jpg",))
    with pytest.raises(UserError, match=r"instances_train2017\.json are not COCO instances") as caught:
        coco.read(root)
    assert "\n" not in str(caught.value)

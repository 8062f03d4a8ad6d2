from __future__ import annotations

import numpy as np
import pytest

from psiamfcpp.datasets import imagenet_vid
from psiamfcpp.errors import UserError

TRAIN = "train/ILSVRC2015_VID_train_0000/ILSVRC2015_train_00000001"
VAL = "val/ILSVRC2015_val_00000000"


def label(*objects: tuple[int, tuple[object, ...]]) -> str:
    """The annotation of a frame: a track and its corners, an object each."""
    corners = "<xmax>{2}</xmax><xmin>{0}</xmin><ymax>{3}</ymax><ymin>{1}</ymin>"
    items = [
        f"<object><trackid>{track}</trackid><name>n02084071</name>"
        f"<bndbox>{corners.format(*box)}</bndbox><occluded>1</occluded><generated>0</generated></object>"
        for track, box in objects
    ]
    return f"<annotation><size><width>9</width></size>{''.join(items)}</annotation>"


def snippet(folder: str, *labels: str) -> dict[str, str]:
    """A snippet with one frame an annotation."""
    files = {f"Annotations/VID/{folder}/{i:06d}.xml": text for i, text in enumerate(labels)}
    return files | {f"Data/VID/{folder}/{i:06d}.JPEG": "" for i in range(len(labels))}


def test_one_sequence_a_track_with_the_frames_that_show_it(lay):
    root = lay(snippet(TRAIN, label((0, (0, 1, 9, 4))), label(), label((1, (5, 5, 5, 5)), (0, (2, 2, 3, 3)))))
    first, second = imagenet_vid.read(root)
    assert (first.name, second.name) == ("ILSVRC2015_train_00000001#0", "ILSVRC2015_train_00000001#1")
    assert first.frames == [root / "Data/VID" / TRAIN / name for name in ("000000.JPEG", "000002.JPEG")]
    assert first.boxes.tolist() == [[0, 1, 10, 4], [2, 2, 2, 2]]
    assert [p.name for p in second.frames] == ["000002.JPEG"]
    assert second.boxes.tolist() == [[5, 5, 1, 1]]
    assert {first.source, second.source} == {"imagenet-vid"}


def test_both_parts_and_stray_files(lay):
    one = label((0, (1, 1, 2, 2)))
    root = lay({**snippet(VAL, one), **snippet(TRAIN, one), "Annotations/VID/val/notes.txt": ""})
    assert [s.name for s in imagenet_vid.read(root)] == [
        "ILSVRC2015_train_00000001#0",
        "ILSVRC2015_val_00000000#0",
    ]


def test_no_box_where_it_is_empty(lay):
    (track,) = imagenet_vid.read(lay(snippet(VAL, label((0, (5, 1, 4, 3))), label((0, (1, 1, 2, 2))))))
    np.testing.assert_equal(track.boxes, [[np.nan] * 4, [1, 1, 2, 2]])


def test_missing_annotations_show_the_layout(lay):
    with pytest.raises(UserError, match="Annotations/VID is missing; expected layout: <root>/Data/VID"):
        imagenet_vid.read(lay({}, empty=(f"Data/VID/{VAL}/000000.JPEG",)))


def test_annotations_without_a_snippet(lay):
    with pytest.raises(UserError, match="holds no snippet; expected layout"):
        imagenet_vid.read(lay({"Annotations/VID/readme": ""}))


def test_missing_frames(lay):
    root = lay(snippet(VAL, label((0, (1, 1, 2, 2)))))
    (root / "Data/VID" / VAL / "000000.JPEG").unlink()
    with pytest.raises(UserError, match=r"val_00000000/000000\.JPEG is missing; expected layout"):
        imagenet_vid.read(root)
    (root / "Data/VID" / VAL).rmdir()
    with pytest.raises(UserError, match="val_00000000 is missing; expected layout"):
        imagenet_vid.read(root)


@pytest.mark.parametrize(
    "text",
    [
        "<annotation><object>",
        label((0, (1, 1, "wide", 2))),
        "<annotation><object><trackid>0</trackid></object></annotation>",
        label((0, (1, 1, 2, 2))).replace("trackid", "id"),
    ],
)
def test_junk_annotation(lay, text: str):
    with pytest.raises(UserError, match=r"val_00000000/000000\.xml cannot be read"):
        imagenet_vid.read(lay(snippet(VAL, text)))

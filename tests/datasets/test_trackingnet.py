from __future__ import annotations

import numpy as np
import pytest

from psiamfcpp.datasets import trackingnet
from psiamfcpp.errors import UserError


def sequence(chunk: str, name: str, *rows: str) -> dict[str, str]:
    """A sequence with one frame a box."""
    frames = {f"{chunk}frames/{name}/{i}.jpg": "" for i in range(len(rows))}
    return {f"{chunk}anno/{name}.txt": "\n".join(rows) + "\n", **frames}


def test_frames_in_the_order_of_their_numbers(lay):
    (only,) = trackingnet.read(lay(sequence("TRAIN_0/", "a", *(f"{i},0,5,5" for i in range(12)))))
    assert [p.name for p in only.frames] == [f"{i}.jpg" for i in range(12)]
    assert only.boxes[:, 0].tolist() == list(range(12))


def test_chunks(lay):
    chunks = {**sequence("TRAIN_1/", "b", "1,2,3,4"), **sequence("TRAIN_0/", "c", "5,6,7,8.5")}
    root = lay({**chunks, **sequence("TRAIN_0/", "a_0", "1,1,1,1"), "TRAIN_2.zip": ""})
    found = trackingnet.read(root)
    assert [s.name for s in found] == ["a_0", "c", "b"]
    assert {s.source for s in found} == {"trackingnet"}
    assert found[1].frames == [root / "TRAIN_0/frames/c/0.jpg"]
    assert found[1].boxes.tolist() == [[5, 6, 7, 8.5]]


def test_one_chunk_as_root(lay):
    root = lay(sequence("TRAIN_7/", "a", "1,2,3,4"))
    assert [s.name for s in trackingnet.read(root / "TRAIN_7")] == ["a"]


def test_no_box_where_it_is_empty(lay):
    (only,) = trackingnet.read(lay(sequence("TRAIN_0/", "a", "1,2,3,4", "1,2,0,4", "1,2,3,-1")))
    np.testing.assert_equal(only.boxes, [[1, 2, 3, 4], [np.nan] * 4, [np.nan] * 4])


def test_missing_annotations_show_the_layout(lay):
    with pytest.raises(UserError, match="TRAIN_0/anno is missing; expected layout: <root>/TRAIN_"):
        trackingnet.read(lay({}, empty=("TRAIN_0/frames/a/0.jpg",)))


def test_missing_frames_show_the_layout(lay):
    with pytest.raises(UserError, match="TRAIN_0/frames/a is missing; expected layout"):
        trackingnet.read(lay({"TRAIN_0/anno/a.txt": "1,2,3,4\n"}))


def test_mismatched_counts_name_the_sequence(lay):
    root = lay(sequence("TRAIN_0/", "a", "1,2,3,4", "1,2,3,4"))
    (root / "TRAIN_0/frames/a/1.jpg").unlink()
    with pytest.raises(UserError, match="TRAIN_0/frames/a has 1 images but 2 boxes"):
        trackingnet.read(root)


def test_junk_numbers(lay):
    with pytest.raises(UserError, match=r"anno/a\.txt cannot be read"):
        trackingnet.read(lay(sequence("TRAIN_0/", "a", "1,2,3,x")))


def test_a_frame_without_a_number(lay):
    root = lay(sequence("TRAIN_0/", "a", "1,2,3,4"), empty=("TRAIN_0/frames/a/cover.jpg",))
    with pytest.raises(UserError, match=r"frame .*cover\.jpg has no number"):
        trackingnet.read(root)

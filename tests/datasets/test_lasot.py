from __future__ import annotations

import numpy as np
import pytest

from psiamfcpp.datasets import lasot
from psiamfcpp.errors import UserError

NAN = [np.nan] * 4
LABELS = {
    "groundtruth.txt": "1,2,3,4\n5,6,7,8\n9,9,9,9\n0,0,0,0\n",
    "full_occlusion.txt": "0,1,0,0\n",
    "out_of_view.txt": "0,0,1,0\n",
}


def sequence(folder: str, **changes: str) -> dict[str, str]:
    """A sequence of four frames, some of its label files (named without suffix) changed."""
    labels = LABELS | {f"{name}.txt": text for name, text in changes.items()}
    frames = {f"img/{i:08d}.jpg": "" for i in (2, 4, 1, 3)}
    return {f"{folder}/{name}": text for name, text in {**labels, **frames}.items()}


def test_class_folders(lay):
    root = lay({**sequence("cat/cat-10"), **sequence("cat/cat-2"), **sequence("air-ship/air-ship-1")})
    found = lasot.read(root)
    assert [s.name for s in found] == ["air-ship-1", "cat-2", "cat-10"]
    assert [s.source for s in found] == ["air-ship", "cat", "cat"]
    assert [p.name for p in found[1].frames] == [f"{i:08d}.jpg" for i in (1, 2, 3, 4)]


def test_flat_folders(lay):
    root = lay({**sequence("dog-3"), **sequence("cat-1"), "README.md": "", "cat-2.zip": ""})
    assert [(s.name, s.source) for s in lasot.read(root)] == [("cat-1", "cat"), ("dog-3", "dog")]


def test_no_box_where_occluded_out_of_view_or_empty(lay):
    (only,) = lasot.read(lay(sequence("cat/cat-1")))
    np.testing.assert_equal(only.boxes, [[1, 2, 3, 4], NAN, NAN, NAN])


@pytest.mark.parametrize("file", [*LABELS, "img"])
def test_missing_file_shows_the_layout(lay, file: str):
    files = {name: text for name, text in sequence("cat/cat-1").items() if f"cat-1/{file}" not in name}
    with pytest.raises(UserError, match=rf"cat-1/{file} is missing; expected layout: <root>"):
        lasot.read(lay(files))


@pytest.mark.parametrize("name", ["groundtruth", "full_occlusion", "out_of_view"])
def test_mismatched_counts_name_the_sequence(lay, name: str):
    text = "1,2,3,4\n" if name == "groundtruth" else "0,0\n"
    with pytest.raises(UserError, match=r"cat-1 has 4 images.*counts must be equal"):
        lasot.read(lay(sequence("cat/cat-1", **{name: text})))


@pytest.mark.parametrize("name", ["groundtruth", "full_occlusion", "out_of_view"])
def test_junk_numbers(lay, name: str):
    with pytest.raises(UserError, match=rf"cat-1/{name}\.txt cannot be read"):
        lasot.read(lay(sequence("cat/cat-1", **{name: "0,x,0,0\n"})))


def test_a_sequence_with_an_image_more_than_labels_is_cut_and_named(lay):
    root = lay({**sequence("cat/cat-1"), "cat/cat-1/img/00000005.jpg": "", **sequence("cat/cat-2", out_of_view="0")})
    left_out: list[str] = []
    (only,) = lasot.read(root, left_out)
    assert (only.name, len(only.frames), len(only.boxes)) == ("cat-1", 4, 4)
    cut, lost = left_out
    assert "cat-1 has 5 images but 4 boxes, 4 occlusion flags, 4 view flags: only the first 4 are used" in cut
    # of three flags that are missing nobody knows which
    assert "cat-2 has 4 images but 4 boxes, 4 occlusion flags, 1 view flags" in lost

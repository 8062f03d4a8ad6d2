from __future__ import annotations

import numpy as np
import pytest

from psiamfcpp.datasets import got10k
from psiamfcpp.errors import UserError

NAN = [np.nan] * 4


def split(part: str, name: str, **changes: str) -> dict[str, str]:
    """A split with one sequence of four frames, some of its files changed."""
    files = {
        "groundtruth": "1.5,2,3,4\n5,6,7,8\n9,9,9,9\n1,1,0,5\n",
        "absence": "0\n1\n0\n0\n",
        "cover": "8\n8\n0\n8\n",
    } | changes
    frames = {f"{part}{name}/{i:08d}.jpg": "" for i in (3, 1, 4, 2)}
    return frames | {
        f"{part}list.txt": f"{name}\n",
        f"{part}{name}/groundtruth.txt": files["groundtruth"],
        f"{part}{name}/absence.label": files["absence"],
        f"{part}{name}/cover.label": files["cover"],
        f"{part}{name}/meta_info.ini": "[METAINFO]\n",
    }


def test_both_splits(lay):
    root = lay({**split("val/", "GOT-10k_Val_000001"), **split("train/", "GOT-10k_Train_000001")})
    train, val = got10k.read(root)
    assert (train.name, val.name) == ("GOT-10k_Train_000001", "GOT-10k_Val_000001")
    assert {train.source, val.source} == {"got10k"}
    assert [p.name for p in train.frames] == [f"{i:08d}.jpg" for i in (1, 2, 3, 4)]


def test_no_box_where_absent_covered_or_empty(lay):
    (sequence,) = got10k.read(lay(split("train/", "GOT-10k_Train_000001")))
    np.testing.assert_equal(sequence.boxes, [[1.5, 2, 3, 4], NAN, NAN, NAN])


def test_the_split_itself_in_the_order_of_its_list(lay):
    files = split("", "GOT-10k_Train_000001") | split("", "GOT-10k_Train_000002")
    root = lay(files | {"list.txt": "GOT-10k_Train_000002\nGOT-10k_Train_000001\n"})
    assert [s.name[-1] for s in got10k.read(root)] == ["2", "1"]


@pytest.mark.parametrize("file", ["groundtruth.txt", "absence.label", "cover.label"])
def test_missing_label_file_shows_the_layout(lay, file: str):
    root = lay(split("train/", "GOT-10k_Train_000001"))
    (root / "train/GOT-10k_Train_000001" / file).unlink()
    with pytest.raises(UserError, match=rf"000001/{file} is missing; expected layout: <root>"):
        got10k.read(root)


def test_missing_list_shows_the_layout(lay):
    root = lay(split("train/", "GOT-10k_Train_000001"))
    (root / "train/list.txt").unlink()
    with pytest.raises(UserError, match=r"train/list\.txt is missing; expected layout"):
        got10k.read(root)


@pytest.mark.parametrize("changes", [{"groundtruth": "1,2,3,4\n"}, {"absence": "0\n"}, {"cover": "8\n"}])
def test_mismatched_counts_name_the_sequence(lay, changes: dict[str, str]):
    with pytest.raises(UserError, match=r"GOT-10k_Val_000001 has 4 images.*counts must be equal"):
        got10k.read(lay(split("val/", "GOT-10k_Val_000001", **changes)))


@pytest.mark.parametrize("changes", [{"groundtruth": "a,b,c,d\n"}, {"absence": "no\n"}, {"cover": "0.5\n"}])
def test_junk_numbers(lay, changes: dict[str, str]):
    with pytest.raises(UserError, match=r"GOT-10k_Val_000001/.* cannot be read"):
        got10k.read(lay(split("val/", "GOT-10k_Val_000001", **changes)))

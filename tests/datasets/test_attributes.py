"""Attribute files in their places."""

from __future__ import annotations

import pytest

from psiamfcpp.datasets import BENCHMARKS
from psiamfcpp.datasets.attributes import NAMES, read_attributes
from psiamfcpp.errors import UserError

PLACES = {
    "uav123-10fps": "anno/UAV123_10fps/att/{}.txt",
    "uav123": "anno/UAV123/att/{}.txt",
    "uav20l": "anno/UAV20L/att/{}.txt",
    "dtb70": "att/{}.txt",
    "uavdt": "anno/{}_att.txt",
    "visdrone2018": "attributes/{}_attr.txt",
    "otb100": "anno/att/{}.txt",
}


@pytest.mark.parametrize(("dataset", "place"), PLACES.items())
@pytest.mark.parametrize("sign", [",", "\t", " ", "\n"])
def test_every_layout(lay, dataset: str, place: str, sign: str):
    columns = NAMES[dataset]
    first = ["1", "0"] + ["0"] * (len(columns) - 2)
    second = ["1", "1"] + ["0"] * (len(columns) - 2)
    root = lay({place.format("a"): sign.join(first) + "\n", place.format("b"): sign.join(second) + "\n"})
    found = read_attributes(dataset, root, ["a", "b"])
    assert list(found) == list(columns)
    assert [found[name] for name in columns[:3]] == [["a", "b"], ["b"], []]


def test_every_benchmark_with_attributes_is_one_and_the_names_differ():
    assert NAMES.keys() == PLACES.keys() < BENCHMARKS.keys()
    assert all(len({*names}) == len(names) for names in NAMES.values())


def test_those_of_uav123_serve_at_10_frames_a_second(lay):
    root = lay({PLACES["uav123"].format("a"): ",".join("1" * 12)})
    assert read_attributes("uav123-10fps", root, ["a"])["low resolution"] == ["a"]


def test_names_beside_the_files_go_first(lay):
    root = lay({"att/a.txt": "0,1", "att/names.txt": "snow\nnight\n"})
    assert read_attributes("dtb70", root, ["a"]) == {"snow": [], "night": ["a"]}
    lay({"att/names.txt": "snow\nsnow\n"})
    with pytest.raises(UserError, match=r"names\.txt holds a name twice"):
        read_attributes("dtb70", root, ["a"])


def test_without_files_there_are_no_attributes(lay):
    assert read_attributes("dtb70", lay({"a.txt": "1,2,3,4\n"}), ["a"]) == {}
    assert read_attributes("folder", lay({"att/a.txt": "1"}), ["a"]) == {}


@pytest.mark.parametrize("text", ["1,0", "1,0,0,0,0,0,0,0,0,0,2", "1,0,0,0,0,0,0,0,0,0,x", "1" * 11, ""])
def test_a_damaged_file_is_named(lay, text: str):
    good = ",".join("1" * 11)
    with pytest.raises(UserError, match=r"att/b\.txt cannot be read .*11 numbers, each 0 or 1"):
        read_attributes("dtb70", lay({"att/a.txt": good, "att/b.txt": text}), ["a", "b"])


def test_a_missing_file_is_named(lay):
    with pytest.raises(UserError, match=r"att/b\.txt does not exist"):
        read_attributes("dtb70", lay({"att/a.txt": ",".join("1" * 11)}), ["a", "b"])

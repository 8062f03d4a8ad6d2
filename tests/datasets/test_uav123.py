from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from psiamfcpp.datasets import BENCHMARKS
from psiamfcpp.errors import UserError

CONFIG = r"""% Konfiguration für alle
case 'UAV123'
seqs = {struct('name','bike1','path','D:\data_seq\UAV123\bike1\','startFrame',1,'endFrame',3,'nz',6,'ext','jpg'),...
    struct('name','car1_1', 'path', [base 'car1\'], 'startFrame', 1, 'endFrame', 2,'nz',6),...
    struct('name','car1_2','path','/data_seq/UAV123/car1/','startFrame',2,'endFrame',4,'nz',6),...
    struct('name','bird1','path','D:\data_seq\UAV123_10fps\bird1\','startFrame',1,'endFrame',2)};
case 'UAV20L'
seqs = {struct('name','bike1','path','D:\data_seq\UAV123\bike1\','startFrame',2,'endFrame',5,'nz',6,'ext','jpg')};
"""


def images(data: str, folder: str, last: int) -> tuple[str, ...]:
    return tuple(f"data_seq/{data}/{folder}/{i:06d}.jpg" for i in range(1, last + 1))


def boxes(rows: int) -> str:
    return "1,2,3,4\n" * (rows - 1) + "NaN,NaN,NaN,NaN\n"


def numbers(frames: list[Path]) -> list[int]:
    return [int(path.stem) for path in frames]


def test_ranges_at_10_fps_come_with_the_package(lay):
    texts = {f"anno/UAV123_10fps/{name}.txt": boxes(rows) for name, rows in (("car16_1", 139), ("car16_2", 527))}
    root = lay(texts | {"anno/UAV123_10fps/att/car16_1.txt": "0,1\n"}, images("UAV123_10fps", "car16", 665))
    first, second = BENCHMARKS["uav123-10fps"].read(root)
    assert (first.name, second.name) == ("car16_1", "car16_2")
    # the two parts share a frame
    assert numbers(first.frames) == list(range(1, 140))
    assert numbers(second.frames) == list(range(139, 666))
    assert {path.parent for path in second.frames} == {root / "data_seq/UAV123_10fps/car16"}
    assert np.isnan(second.boxes[-1]).all()


def test_shipped_ranges_are_whole():
    benchmark = BENCHMARKS["uav123-10fps"]
    from psiamfcpp.datasets.uav123 import _shipped_ranges

    ranges = _shipped_ranges()
    assert len(ranges) == benchmark.size
    assert all(part.first <= part.last for (part,) in ranges.values())
    # a folder is a name without its part
    assert all(name == part.folder or name.rsplit("_", 1)[0] == part.folder for name, (part,) in ranges.items())


@pytest.mark.parametrize("place", ["configSeqs.m", "toolkit/configSeqs.m"])
def test_ranges_of_the_download(lay, place: str):
    texts = {
        "anno/UAV123/bike1.txt": boxes(3),
        "anno/UAV123/car1_1.txt": boxes(2),
        "anno/UAV123/car1_2.txt": boxes(3),
        "anno/UAV20L/bike1.txt": boxes(4),
    }
    root = lay(texts, images("UAV123", "bike1", 5) + images("UAV123", "car1", 4))
    (root / place).parent.mkdir(exist_ok=True)
    (root / place).write_bytes(CONFIG.encode("latin-1"))
    bike, first, second = BENCHMARKS["uav123"].read(root)
    assert [numbers(s.frames) for s in (bike, first, second)] == [[1, 2, 3], [1, 2], [2, 3, 4]]
    # the same name and folder, told apart by the number of labels
    (long,) = BENCHMARKS["uav20l"].read(root)
    assert numbers(long.frames) == [2, 3, 4, 5]


@pytest.mark.parametrize(
    ("name", "rows", "first", "last"),
    [
        # bird1_2 has frames 259 to 493 at 10 frames a second: 775 to 1477 of those at 30
        ("bird1_2", 703, 775, 1477),
        # person12_2 from 201 on: 601 to 1621
        ("person12_2", 1021, 601, 1621),
        # uav6 is a whole video of 37 frames at 10 a second: 109 to 111 at 30
        ("uav6", 109, 1, 109),
        ("uav6", 111, 1, 111),
    ],
)
def test_ranges_at_30_fps_follow_from_those_at_10(lay, name: str, rows: int, first: int, last: int):
    root = lay({f"anno/UAV123/{name}.txt": boxes(rows)}, images("UAV123", name.partition("_")[0], last))
    (sequence,) = BENCHMARKS["uav123"].read(root)
    assert numbers(sequence.frames) == list(range(first, last + 1))
    assert {path.parent.name for path in sequence.frames} == {name.partition("_")[0]}


def test_a_sequence_of_uav20l_is_a_whole_video(lay):
    root = lay({"anno/UAV20L/bird1.txt": boxes(3)}, images("UAV123", "bird1", 4))
    (bird,) = BENCHMARKS["uav20l"].read(root)
    assert numbers(bird.frames) == [1, 2, 3]


@pytest.mark.parametrize("name", ["uav123", "uav123-10fps"])
def test_a_folder_with_a_frame_a_label_needs_no_range(lay, name: str):
    data = {"uav123": "UAV123", "uav123-10fps": "UAV123_10fps"}[name]
    root = lay({f"anno/{data}/bike1.txt": boxes(3), f"anno/{data}/mine.txt": boxes(2)}, images(data, "bike1", 3))
    lay({}, images(data, "mine", 2))
    assert [numbers(sequence.frames) for sequence in BENCHMARKS[name].read(root)] == [[1, 2, 3], [1, 2]]


def test_a_part_of_a_video_needs_a_range(lay):
    root = lay({"anno/UAV123/mine_1.txt": boxes(2)}, images("UAV123", "mine", 4))
    with pytest.raises(UserError, match=r"sequence mine_1 has is not known: put .*configSeqs\.m into the root"):
        BENCHMARKS["uav123"].read(root)


def test_labels_that_do_not_fit_their_range(lay):
    root = lay({"anno/UAV123_10fps/uav6.txt": boxes(36)}, images("UAV123_10fps", "uav6", 37))
    with pytest.raises(UserError, match=r"uav6 has 36 boxes, but its range of frames holds 37"):
        BENCHMARKS["uav123-10fps"].read(root)


def test_what_is_missing_is_named(lay):
    benchmark = BENCHMARKS["uav123-10fps"]
    root = lay({"anno/UAV123_10fps/uav6.txt": boxes(37)})
    assert list(benchmark.read_labels(root)) == ["uav6"]
    with pytest.raises(UserError, match=r"data_seq/UAV123_10fps is missing; expected layout: <root>/data_seq"):
        benchmark.read(root)
    lay({}, images("UAV123_10fps", "uav6", 36))
    with pytest.raises(UserError, match=r"uav6/000037\.jpg is missing; expected layout"):
        benchmark.read(root)
    (root / "data_seq/UAV123_10fps/uav6").rename(root / "data_seq/UAV123_10fps/uav7")
    with pytest.raises(UserError, match=r"uav6 is missing; expected layout"):
        benchmark.read(root)

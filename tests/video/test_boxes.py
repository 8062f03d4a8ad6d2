"""Boxes as text, CSV and JSON lines: what is in them, and what is left when writing ends badly."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.trackers import Track
from psiamfcpp.video.boxes import COLUMNS, BoxWriter, boxes_paths

ONE, SILENT = Track((1, 2.005, 3.999, 40), 0.51234, "unsure"), Track((-1.5, 0, 1e4, 2), None, None)
FOUR = Track((1, 2, 3, 4), 1.0, "tracking")


def test_boxes_are_on_disk_as_they_are_written(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with pytest.raises(KeyboardInterrupt), BoxWriter(path) as writer:
        writer.write(0, [ONE])
        assert path.read_text() == "1.00,2.00,4.00,40.00\n"
        writer.write(1, [SILENT])
        raise KeyboardInterrupt
    assert path.read_text() == "1.00,2.00,4.00,40.00\n-1.50,0.00,10000.00,2.00\n"


def test_several_targets_have_a_text_file_each(tmp_path: Path) -> None:
    with BoxWriter(tmp_path / "a.txt", targets=2) as writer:
        writer.write(0, [ONE, SILENT])
    assert (tmp_path / "a.1.txt").read_text() == "1.00,2.00,4.00,40.00\n"
    assert (tmp_path / "a.2.txt").read_text() == "-1.50,0.00,10000.00,2.00\n"


def test_csv_holds_every_target_with_time_score_and_state(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    with BoxWriter(path, targets=2, fps=25) as writer:
        writer.write(0, [ONE, SILENT])
        writer.write(5, [FOUR, SILENT])
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert [(row["seconds"], row["frame"], row["target"]) for row in rows] == [
        ("0.000", "0", "1"),
        ("0.000", "0", "2"),
        ("0.200", "5", "1"),
        ("0.200", "5", "2"),
    ]
    assert [(row["w"], row["score"], row["state"]) for row in rows[:2]] == [
        ("4.00", "0.512", "unsure"),
        ("10000.00", "", ""),
    ]


def test_json_lines_hold_one_object_per_target_and_frame(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    with BoxWriter(path, targets=2, fps=10) as writer:
        writer.write(3, [FOUR, SILENT])
    first, second = (json.loads(line) for line in path.read_text().splitlines())
    assert first == {"seconds": 0.3, "frame": 3, "target": 1, "box": [1, 2, 3, 4], "score": 1.0, "state": "tracking"}
    assert (second["target"], second["score"], second["state"]) == (2, None, None)


@pytest.mark.parametrize(
    ("name", "count", "expected"),
    [
        ("b.txt", 1, ["b.txt"]),
        ("b.txt", 2, ["b.1.txt", "b.2.txt"]),
        ("b", 2, ["b.1", "b.2"]),
        ("b.csv", 2, ["b.csv"]),
        ("b.JSONL", 3, ["b.JSONL"]),
    ],
)
def test_files_by_name_and_targets(name: str, count: int, expected: list[str]) -> None:
    assert [str(path) for path in boxes_paths(Path(name), count)] == expected


def test_a_full_disk_leaves_whole_lines(tmp_path: Path, disk_of: Any) -> None:
    path = tmp_path / "a.txt"
    with BoxWriter(path) as writer, disk_of(50), pytest.raises(UserError, match=f"{path} cannot be written"):
        for frame in range(10):
            writer.write(frame, [FOUR])
    assert path.read_text() == "1.00,2.00,3.00,4.00\n" * 2


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/dev/full")
def test_a_full_device_is_an_error() -> None:
    with BoxWriter("/dev/full") as writer, pytest.raises(UserError, match="/dev/full cannot be written"):
        writer.write(0, [FOUR])


def test_boxes_into_a_missing_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be written"):
        BoxWriter(tmp_path / "none" / "a.txt")

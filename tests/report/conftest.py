"""A miniature of DTB70 with frames and attributes, and trackers that were run over it."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest

from psiamfcpp import datasets
from psiamfcpp.evaluation.running import RUN_FILE, run
from psiamfcpp.report.compare import Comparison, collect
from psiamfcpp.trackers import choose

PATH = [(100.0 + 3 * t, 80.0 + t, 40.0, 30.0) for t in range(5)]
OTHER = "K&F_<1>"
MODULE = """
class blob:
    def init(self, image, box):
        pass
    def update(self, image):
        rows, columns = (image[..., 0] > 150).nonzero()
        return columns.min(), rows.min(), columns.max() - columns.min() + 1, rows.max() - rows.min() + 1
"""


@pytest.fixture(scope="session")
def _made(tmp_path_factory: pytest.TempPathFactory, blob_frame: Callable[..., Any]) -> Path:
    """A folder with two sequences, the second with a zero label at its end, and results of two trackers on them.

    One tracker was run; the other's boxes, which all lie where the target began, were found somewhere.
    """
    place = tmp_path_factory.mktemp("made")
    root, results = place / "DTB70", place / "results"
    for name in ("Car1", "Car2"):
        (root / name / "img").mkdir(parents=True)
        for number, box in enumerate(PATH, start=1):
            cv2.imwrite(str(root / name / "img" / f"{number:05}.png"), blob_frame(box))
        lines = [",".join(map(str, box)) for box in PATH]
        if name == "Car2":
            lines[-1] = "0,0,0,0"
        (root / name / "groundtruth_rect.txt").write_text("\n".join(lines) + "\n")
    (root / "att").mkdir()
    (root / "att" / "Car1.txt").write_text("1,0,0,0,0,0,0,0,0,0,0\n")
    (root / "att" / "Car2.txt").write_text("1,1,0,0,0,0,0,0,0,0,0\n")
    (place / "tracker_for_reports.py").write_text(MODULE)
    sys.path.insert(0, str(place))
    try:
        sequences = datasets.BENCHMARKS["dtb70"].read(root)
        assert run([choose("tracker_for_reports:blob")], "dtb70", root, sequences, results) == []
    finally:
        sys.path.remove(str(place))
    for sequence in sequences:
        path = results / "dtb70" / OTHER / f"{sequence.name}.txt"
        path.parent.mkdir(exist_ok=True)
        path.write_text("100,80,40,30\n" * len(sequence))
    return place


@pytest.fixture
def dtb70(_made: Path, tmp_path: Path) -> Path:
    """The benchmark, free to be changed."""
    return Path(shutil.copytree(_made / "DTB70", tmp_path / "DTB70"))


@pytest.fixture
def results(_made: Path, dtb70: Path, tmp_path: Path) -> Path:
    """The results, free to be changed."""
    copy = Path(shutil.copytree(_made / "results", tmp_path / "results"))
    path = copy / "dtb70" / "blob" / RUN_FILE
    path.write_text(json.dumps({**json.loads(path.read_text()), "root": str(dtb70)}))
    return copy


@pytest.fixture
def comparison(results: Path) -> Comparison:
    """The one benchmark with its two trackers."""
    return collect([results])[0]


@pytest.fixture(scope="session")
def report(_made: Path) -> list[Path]:
    """The files of a report on them, the page first; for looking at only."""
    pytest.importorskip("matplotlib")
    from psiamfcpp.report.writing import write_report

    return write_report(collect([_made / "results"]), _made / "deep" / "report")

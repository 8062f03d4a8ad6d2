"""Miniatures of the paper's four benchmarks in their official layouts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest

PATH = [(100.0 + 3 * t, 80.0 + t, 40.0, 30.0) for t in range(5)]
# Sequence, its folder of frames, the form of a frame's name, and its labels.
MINIATURES = {
    "UAV123_10fps": ("data_seq/UAV123_10fps/boat3", "{:06}.jpg", "anno/UAV123_10fps/boat3.txt"),
    "DTB70": ("BMX3/img", "{:05}.jpg", "BMX3/groundtruth_rect.txt"),
    "UAVDT": ("sequences/S0304", "img{:06}.jpg", "anno/S0304_gt.txt"),
    "VisDrone2018-SOT-test-dev": ("sequences/uav1", "img{:07}.jpg", "annotations/uav1.txt"),
}


@pytest.fixture
def benchmarks(tmp_path: Path, blob_frame: Callable[..., Any]) -> Path:
    """Four benchmarks of one sequence each, in which a blob moves."""
    root = tmp_path / "benchmarks"
    for name, (folder, frame, labels) in MINIATURES.items():
        (root / name / folder).mkdir(parents=True)
        (root / name / labels).parent.mkdir(parents=True, exist_ok=True)
        (root / name / labels).write_text("".join(",".join(map(str, box)) + "\n" for box in PATH))
        for number, box in enumerate(PATH, start=1):
            cv2.imwrite(str(root / name / folder / frame.format(number)), blob_frame(box))
    return root

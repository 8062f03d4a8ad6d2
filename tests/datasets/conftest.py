"""Miniature datasets, written file by file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

Lay = Callable[..., Path]


@pytest.fixture
def lay(tmp_path: Path) -> Lay:
    """Writes text files below a root, and empty ones where a reader needs the name alone (images)."""

    def write(texts: dict[str, str], empty: tuple[str, ...] = ()) -> Path:
        root = tmp_path / "data"
        root.mkdir(exist_ok=True)
        for name, text in {**dict.fromkeys(empty, ""), **texts}.items():
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return root

    return write


def write_video(path: Path, frames: int, start: int = 0) -> Path:
    """A small video whose frame ``k`` is grey at ``10 * (start + k)``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25, (64, 48))
    for number in range(start, start + frames):
        writer.write(np.full((48, 64, 3), 10 * number, np.uint8))
    writer.release()
    return path


def level(image: NDArray[np.uint8]) -> int:
    """The number that `write_video` wrote into a frame."""
    return round(float(image.mean()) / 10)

"""The one form in which every dataset hands out its labels."""

from __future__ import annotations

from collections.abc import Sequence as Frames
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.datasets.frames import Frame, read_frame
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import FloatArray, Image
from psiamfcpp.images import ImageReader


@dataclass(frozen=True, slots=True)
class Sequence:
    """One target through the frames of a clip, or one object in a photograph (a single frame)."""

    name: str
    frames: Frames[Frame]
    """where the frames are, in time order; `frame` reads one"""
    boxes: FloatArray
    """``(n, 4)`` as ``(x, y, w, h)``, pixels, one row per frame; for training NaN where the target is not seen"""
    source: str = ""
    """the collection that it comes from: training samples source by source, so that none drowns the rest"""
    clip: str = ""
    """the clip that it is a track of, where a clip has several; empty where the name is the clip's"""

    def __len__(self) -> int:
        return len(self.frames)

    def usable(self, min_side: float = 0.0) -> NDArray[np.intp]:
        """Return the rows ``(k,)`` whose box is four finite numbers with both sides above 0 and at least ``min_side``.

        Args:
            min_side: pixels.
        """
        sides = self.boxes[:, 2:]
        # A comparison with NaN is False.
        return np.flatnonzero(np.isfinite(self.boxes).all(axis=1) & ((sides > 0) & (sides >= min_side)).all(axis=1))

    def frame(self, number: int, images: ImageReader | None = None) -> Image:
        """Frame ``number``, from 0, as ``(height, width, 3)`` uint8, BGR; frames of a video are cheap in order.

        Raises:
            UserError: it cannot be read.
        """
        return read_frame(self.frames[number], images)


def require(path: Path, layout: str) -> Path:
    """The path, if it exists.

    Args:
        path: a file or folder that a dataset's layout needs.
        layout: the expected layout, shown when it is missing.

    Raises:
        UserError: nothing is there; names the path and shows the layout.
    """
    if not path.exists():
        raise UserError(f"{path} is missing; expected layout: {layout}")
    return path


def labelled(name: str, frames: Frames[Frame], boxes: FloatArray, source: str) -> Sequence:
    """A sequence whose labels stand as published, one row per frame.

    Raises:
        UserError: there are more frames than labels, or fewer.
    """
    if len(frames) != len(boxes):
        raise UserError(f"sequence {name} has {len(frames)} images but {len(boxes)} boxes: fetch it again")
    return Sequence(name, frames, boxes, source)

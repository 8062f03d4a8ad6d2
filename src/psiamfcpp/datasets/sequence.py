"""The one form in which every dataset hands out its labels, and what its readers share."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from collections.abc import Sequence as Frames
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.datasets.boxes import read_boxes
from psiamfcpp.datasets.frames import Frame, read_frame
from psiamfcpp.errors import UserError
from psiamfcpp.files import reading
from psiamfcpp.geometry import FloatArray, Image
from psiamfcpp.images import ImageReader, image_files

Item = TypeVar("Item")
LeftOut = list[str] | None
"""Lines on what a reader has left out, which it appends to; None where what it cannot read is an error.

A reader that is given a list leaves out the rows, images and sequences that are not as its layout says.
"""
# A copy of a set may have an image more than it has labels; where more are missing, nobody knows which.
_CUT = 2


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


@contextlib.contextmanager
def tolerated(left_out: LeftOut) -> Iterator[None]:
    """Note a `UserError` of the block in ``left_out``; without a list it is raised."""
    try:
        with reading():
            yield
    except UserError as error:
        if left_out is None:
            raise
        left_out.append(str(error))


def each(items: Iterable[Item], make: Callable[[Item], Sequence], left_out: LeftOut) -> list[Sequence]:
    """The sequences that ``make`` makes of items, without those that it cannot make.

    Raises:
        UserError: one cannot be made, and ``left_out`` is None.
    """
    found = []
    for item in items:
        with tolerated(left_out):
            found.append(make(item))
    return found


def matched(
    name: str, frames: Frames[Frame], rows: dict[str, int], left_out: LeftOut = None, fix: str = "fetch it again"
) -> int:
    """Return the number of frames that have labels: all of them, since the counts must be equal.

    Args:
        name: of the sequence.
        frames: its frames.
        rows: number of rows of each kind of label.
        left_out: given a list, a sequence whose counts differ by one or two is cut at its end.
        fix: what to do about another, for the error.

    Raises:
        UserError: the counts differ.
    """
    shortest, longest = min(len(frames), *rows.values()), max(len(frames), *rows.values())
    if shortest == longest:
        return shortest
    counts = f"{len(frames)} images but {', '.join(f'{count} {kind}' for kind, count in rows.items())}"
    if left_out is None or not 0 < longest - shortest <= _CUT or not shortest:
        raise UserError(f"sequence {name} has {counts}: the counts must be equal, {fix}")
    left_out.append(f"sequence {name} has {counts}: only the first {shortest} are used")
    return shortest


class Present:
    """The files below a folder, listed folder by folder when first asked for: many images share few folders."""

    def __init__(self, root: Path):
        self._root = root
        self._listed: dict[Path, set[str]] = {}

    def find(self, name: str | Path, asked: str) -> Path:
        """Return the path of an image.

        Args:
            name: relative to the root, with its folders.
            asked: what names it, for the error.

        Raises:
            UserError: it is not there.
        """
        path = self._root / name
        if path.parent not in self._listed:
            with contextlib.suppress(OSError, ValueError):
                self._listed[path.parent] = {entry.name for entry in path.parent.iterdir()}
        if path.name not in self._listed.get(path.parent, ()):
            raise UserError(f"image {path} does not exist, which {asked} names: fetch it, or remove what names it")
        return path


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
    matched(name, frames, {"boxes": len(boxes)})
    return Sequence(name, frames, boxes, source)


def labelled_by(
    files: Mapping[str, Path], folder: Callable[[str, Path], Path], layout: str, source: str, left_out: LeftOut
) -> list[Sequence]:
    """Sequences of one label file and one folder of images each, labels as published.

    Args:
        files: label file of each sequence, by name.
        folder: the folder of images, from a sequence's name and label file.
        layout: the expected layout, shown when a folder is missing.
        source: the collection.
        left_out: see `LeftOut`.

    Raises:
        UserError: a file is missing or unreadable, or the frames and boxes differ in number.
    """

    def one(item: tuple[str, Path]) -> Sequence:
        images = image_files(require(folder(*item), layout).iterdir())
        return labelled(item[0], images, read_boxes(item[1]), source)

    return each(files.items(), one, left_out)

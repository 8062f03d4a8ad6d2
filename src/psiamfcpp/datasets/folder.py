"""A plain folder of sequences, at any depth: ``<root>/.../<name>/{img/* or video.mp4, groundtruth_rect.txt}``."""

from __future__ import annotations

import re
from pathlib import Path

from psiamfcpp.datasets.boxes import find_files, read_boxes
from psiamfcpp.datasets.frames import video_frames
from psiamfcpp.datasets.sequence import LeftOut, Sequence, each, matched
from psiamfcpp.errors import UserError
from psiamfcpp.images import image_files

LAYOUT = (
    "<root>/.../<sequence>/img/*.jpg, or video.mp4 in its place, and <root>/.../<sequence>/groundtruth_rect.txt "
    "(x,y,w,h per frame)"
)


def label_files(root: Path) -> dict[str, Path]:
    """The label file of each sequence, by name.

    Raises:
        UserError: two sequences have one name.
    """
    files: dict[str, Path] = {}
    for path in find_files(root, "**/groundtruth_rect.txt"):
        other = files.setdefault(path.parent.name, path)
        if other != path:
            raise UserError(f"{other.parent} and {path.parent} have one name: rename one of the two sequences")
    return files


def read(root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """Every sequence under ``root``, by name; the source is the name up to its first ``_`` or digit.

    Raises:
        UserError: there is none, or one has another number of frames than of boxes.
    """
    truths = find_files(root, "**/groundtruth_rect.txt")
    if not truths:
        raise UserError(
            f"{root} holds no sequence: {root}/.../groundtruth_rect.txt is missing; expected layout: {LAYOUT}"
        )
    return each(truths, lambda truth: _sequence(truth.parent), left_out)


def source_of(name: str) -> str:
    """Return the collection that a clip's name begins with: what stands before its first ``_`` or digit."""
    return re.split(r"[_\d]", name, maxsplit=1)[0]


def _sequence(folder: Path) -> Sequence:
    boxes, video = read_boxes(folder / "groundtruth_rect.txt"), folder / "video.mp4"
    images = image_files((folder / "img").glob("*"))
    # The frames as they were taken, where both are there.
    frames = images if images or not video.exists() else video_frames(video)
    matched(str(folder), frames, {"boxes": len(boxes)}, fix="correct the folder")
    return Sequence(folder.name, frames, boxes, source_of(folder.name))

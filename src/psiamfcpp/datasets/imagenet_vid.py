"""ImageNet VID (ILSVRC2015): ``<root>/Data/VID/...`` and ``<root>/Annotations/VID/...``, alike.

The corners are taken as published, without a shift; their last column and row belong to the target.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from psiamfcpp.datasets.boxes import find_files
from psiamfcpp.datasets.sequence import LeftOut, Sequence, require, tolerated
from psiamfcpp.errors import UserError, brief
from psiamfcpp.files import read_bytes
from psiamfcpp.geometry import from_corners
from psiamfcpp.images import image_files

LAYOUT = (
    "<root>/Data/VID/{train/ILSVRC2015_VID_train_000X/<snippet>, val/<snippet>}/000000.JPEG "
    "and the same below <root>/Annotations/VID with 000000.xml"
)
CORNERS = ("xmin", "ymin", "xmax", "ymax")


def read(root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """One sequence a track of a snippet, made of the frames that show the track.

    Raises:
        UserError: there is no snippet, an annotation cannot be read, or its frame is missing.
    """
    labels = require(root / "Annotations" / "VID", LAYOUT)
    snippets = [p for part in ("train/*/*", "val/*") for p in find_files(labels, part) if p.is_dir()]
    if not snippets:
        raise UserError(f"{labels} holds no snippet; expected layout: {LAYOUT}")
    data = root / "Data" / "VID"
    return [s for snippet in snippets for s in _tracks(snippet, data / snippet.relative_to(labels), left_out)]


def _tracks(labels: Path, data: Path, left_out: LeftOut) -> list[Sequence]:
    images, tracks = dict[str, Path](), dict[str, list[tuple[Path, list[float]]]]()
    with tolerated(left_out):
        images = {path.stem: path for path in image_files(require(data, LAYOUT).iterdir())}
    for label in find_files(labels, "*.xml") if images or left_out is None else ():
        with tolerated(left_out):
            for track, corners in _objects(label):
                if label.stem not in images:
                    raise UserError(f"{data / label.stem}.JPEG is missing; expected layout: {LAYOUT}")
                tracks.setdefault(track, []).append((images[label.stem], corners))
    return [_sequence(f"{labels.name}#{track}", shown) for track, shown in tracks.items()]


def _objects(label: Path) -> list[tuple[str, list[float]]]:
    content = read_bytes(label, "annotation", "fetch it again", 2**24)
    try:
        return [
            (_text(item, "trackid"), [float(_text(item, f"bndbox/{key}")) for key in CORNERS])
            for item in ElementTree.fromstring(content).iterfind("object")
        ]
    # LookupError: an encoding that is not known
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise UserError(f"annotation {label} cannot be read ({brief(error)}): fetch it again") from None


def _text(item: ElementTree.Element, path: str) -> str:
    text = item.findtext(path)
    if not text:
        raise ValueError(f"an object without {path}")
    return text


def _sequence(name: str, shown: list[tuple[Path, list[float]]]) -> Sequence:
    boxes = from_corners([corners for _, corners in shown])
    boxes[~(boxes[:, 2:] > 0).all(axis=1)] = np.nan
    return Sequence(name, [frame for frame, _ in shown], boxes, "imagenet-vid")

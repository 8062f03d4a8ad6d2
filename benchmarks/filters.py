"""Compare correlation filters with their authors' own boxes, frame by frame and in scores, and time them.

    python benchmarks/filters.py --root SEQUENCES --peers BOXES [--trackers kcf fdsst]

SEQUENCES holds `<benchmark>/<sequence>/{img/*, groundtruth_rect.txt}`, BOXES
`<benchmark>/<tracker of the authors>/<sequence>.txt`. Rates are of `update` alone, without decoding, per
second of processor time of all threads, so that other programs on the machine do not count.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tyro

from psiamfcpp.datasets.folder import read, read_boxes
from psiamfcpp.datasets.sequence import Sequence
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.metrics import score_sequence
from psiamfcpp.geometry import FloatArray, centre_error
from psiamfcpp.images import read_image
from psiamfcpp.trackers.dcf import FILTERS, open_dcf

# Folder of the authors' boxes by tracker; RACF's have never been published.
FOLDERS = {
    "kcf": "KCF",
    "fdsst": "fDSST",
    "staple-ca": "Staple_CA",
    "bacf": "BACF",
    "eco-hc": "ECO_HC",
    "mcct-h": "MCCT_H",
    "strcf": "STRCF",
    "arcf-hc": "ARCF",
    "autotrack": "AutoTrack",
}
# Boxes are equal where no number differs by more, in pixels.
SAME = 0.01
FIRST_FRAMES = 30
LINE = "{:10} {:14} {:>6} {:>9} {:>9} {:>8} {:>13} {:>13} {:>7}"


@dataclass(frozen=True)
class Comparison:
    """One tracker compared with its authors' boxes on one sequence."""

    frames: int
    identical: int
    """frames equal from the first on, that of the label left out"""
    equal: int
    """equal frames among the first `FIRST_FRAMES`"""
    distance: float
    """median distance of centres over these, pixels"""
    ours: tuple[float, float]
    """precision at 20 pixels and AUC"""
    authors: tuple[float, float] | None
    fps: float


def follow(name: str, sequence: Sequence) -> tuple[FloatArray, float]:
    """Return boxes of a tracker on a sequence, and the rate of its updates after the first, which warms up."""
    tracker = open_dcf(name)
    boxes, seconds = sequence.boxes.copy(), []
    for i, path in enumerate(sequence.frames):
        frame = read_image(path)
        if i == 0:
            tracker.init(frame, boxes[0])
            continue
        begin = time.process_time()
        boxes[i] = tracker.update(frame).box
        seconds.append(time.process_time() - begin)
    return boxes, 1 / float(np.mean(seconds[1:]))


def compare(name: str, sequence: Sequence, theirs: FloatArray | None) -> Comparison:
    boxes, fps = follow(name, sequence)

    def figures(result: FloatArray) -> tuple[float, float]:
        found = score_sequence(sequence.boxes, result).figures
        return found["precision"], found["auc"]

    if theirs is None:
        return Comparison(len(boxes), 0, 0, float("nan"), figures(boxes), None, fps)
    same = (np.abs(boxes - theirs) <= SAME).all(axis=1)
    same[0] = True  # the label; some authors' files hold it rounded
    identical = len(same) if same.all() else int(np.argmin(same))
    head = slice(1, FIRST_FRAMES + 1)
    distance = float(np.median(centre_error(boxes[head], theirs[head])))
    return Comparison(len(boxes), identical - 1, int(same[head].sum()), distance, figures(boxes), figures(theirs), fps)


def main(root: Path, peers: Path, trackers: tuple[str, ...] = tuple(FOLDERS)) -> None:
    """Compare trackers with their authors' boxes.

    Args:
        root: folder of sequences.
        peers: folder of the authors' boxes.
        trackers: which ones; by default all.
    """
    cv2.setNumThreads(1)
    sequences = read(root)
    print(LINE.format("tracker", "sequence", "frames", "identical", "first 30", "median", "ours", "authors", "fps"))
    for name in trackers:
        if name not in FILTERS:
            raise UserError(f"tracker {name!r} is not known: choose from {', '.join(FILTERS)}")
        rows = []
        for sequence in sequences:
            path = next(peers.glob(f"*/{FOLDERS.get(name, name)}/{sequence.name}.txt"), None)
            row = compare(name, sequence, None if path is None else read_boxes(path)[: len(sequence)])
            rows.append(row)
            theirs = "-" if row.authors is None else "{:.3f} {:.3f}".format(*row.authors)
            print(
                LINE.format(
                    name, sequence.name, row.frames, "-" if path is None else row.identical,
                    "-" if path is None else row.equal, f"{row.distance:.2f}", "{:.3f} {:.3f}".format(*row.ours),
                    theirs, f"{row.fps:.1f}",
                ),
                flush=True,
            )  # fmt: skip
        with_boxes = [row for row in rows if row.authors is not None]
        if with_boxes:
            ours = np.mean([row.ours for row in with_boxes], axis=0)
            authors = np.mean([row.authors for row in with_boxes if row.authors], axis=0)
            difference = ours - authors
            print(
                f"{name:10} mean of {len(with_boxes)}: ours {ours[0]:.3f} {ours[1]:.3f}, "
                f"authors {authors[0]:.3f} {authors[1]:.3f}, difference {difference[0]:+.3f} {difference[1]:+.3f}; "
                f"{1 / np.mean([1 / row.fps for row in rows]):.1f} fps"
            )


if __name__ == "__main__":
    tyro.cli(main)

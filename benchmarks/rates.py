"""Time the correlation filters beside OpenCV's TrackerMIL and NanoTrack, in the same rounds.

    python benchmarks/rates.py --root SEQUENCES [SEQUENCES ...] --sequences NAME [NAME ...]
        [--beside opencv:mil nanotrack:v3,backbone=FILE,head=FILE]

Every frame is decoded once and given to each tracker in turn, so that other load on the machine slows all alike. Times
are of `update` alone, on one thread, in seconds of processor time; the first update, which compiles and allocates, does
not count. Prints updates per second and, for each tracker of --beside, how many times its rate that is.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import tyro

from psiamfcpp import datasets
from psiamfcpp.datasets import Sequence
from psiamfcpp.datasets.frames import FrameStore
from psiamfcpp.errors import UserError
from psiamfcpp.trackers import TrackerOptions, open_tracker
from psiamfcpp.trackers.dcf import FILTERS


def rates(names: list[str], sequence: Sequence, frames: int) -> dict[str, float]:
    """Return updates per second of processor time of each tracker on the first frames of a sequence."""
    trackers = {name: open_tracker(name, TrackerOptions(threads=1)) for name in names}
    seconds: dict[str, list[float]] = {name: [] for name in names}
    store = FrameStore()
    for i, source in enumerate(sequence.frames[:frames]):
        frame = store.read(source)
        for name, tracker in trackers.items():
            begin = time.process_time()
            if i == 0:
                tracker.init(frame, sequence.boxes[0])
            else:
                tracker.update(frame)
            seconds[name].append(time.process_time() - begin)
    for tracker in trackers.values():
        tracker.close()
    return {name: 1 / float(np.mean(spent[2:])) for name, spent in seconds.items()}


def main(
    root: tuple[Path, ...],
    sequences: tuple[str, ...],
    trackers: tuple[str, ...] = tuple(f"dcf:{name}" for name in FILTERS),
    beside: tuple[str, ...] = ("opencv:mil",),
    frames: int = 60,
) -> None:
    """Time trackers in the same rounds.

    Args:
        root: folders of sequences, images or videos.
        sequences: names of those to run.
        trackers: as for `psiamfcpp evaluate --tracker`.
        beside: trackers that rates are set in ratio to.
        frames: of each sequence, at most.
    """
    if frames < 3:
        raise UserError(f"{frames} frames: at least 3 are needed, as the first two are not timed")
    known = {sequence.name: sequence for folder in root for sequence in datasets.read("folder", folder)}
    unknown = next((name for name in sequences if name not in known), None)
    if unknown is not None:
        raise UserError(f"sequence {unknown!r} is not under {', '.join(map(str, root))}")
    names = [*trackers, *(name for name in beside if name not in trackers)]
    for name in sequences:
        found = rates(names, known[name], frames)
        print(f"{name}, {min(frames, len(known[name]))} frames")
        shown = [other.split(",")[0] for other in beside]
        print(f"  {'tracker':18} {'1/s':>8}" + "".join(f" {'/ ' + other:>14}" for other in shown))
        for tracker, rate in found.items():
            ratios = "".join(f" {rate / found[other]:14.2f}" for other in beside)
            print(f"  {tracker.split(',')[0]:18} {rate:8.1f}{ratios}", flush=True)


if __name__ == "__main__":
    tyro.cli(main)

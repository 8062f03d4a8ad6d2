"""Fingerprint the boxes of models on known clips, to show that a change of code leaves them as they were.

    python benchmarks/boxes.py --root SEQUENCES > before.txt

Prints one line per model, procedure and clip: the number of frames, the last box, and a checksum of all boxes to two
digits with their states. Run it before and after a change with the same threads, and compare the two outputs.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import tyro

from psiamfcpp import Tracker
from psiamfcpp.datasets import Sequence, read
from psiamfcpp.demo.clip import render
from psiamfcpp.geometry import Box, Image
from psiamfcpp.zoo import graph_names


def main(models: tuple[str, ...] = (), root: Path | None = None, frames: int = 200, threads: int = 1) -> None:
    """Follow and print.

    Args:
        models: shipped models or model files; by default all that are shipped as graphs.
        root: folder of sequences; by default the rendered clip alone.
        frames: most frames per clip.
        threads: threads of the engine.
    """
    clips = {"demo": _demo, **({} if root is None else {s.name: _frames_of(s) for s in read("folder", root)})}
    for model in models or sorted(graph_names()):
        for plain in (False, True):
            for name, clip in clips.items():
                way = "plain" if plain else "states"
                print(f"{model:26} {way:6} {name:14} {_follow(model, plain, threads, clip(), frames)}", flush=True)


def _follow(model: str, plain: bool, threads: int, clip: Iterator[tuple[Image, Box]], frames: int) -> str:
    tracker = Tracker(model, threads=threads, plain=plain)
    lines = []
    for image, box in islice(clip, frames):
        track = tracker.update(image) if lines else tracker.init(image, box)
        lines.append(",".join(f"{v:.2f}" for v in track.box) + f",{track.state}")
    return f"{len(lines):4} frames  {hashlib.sha256(chr(10).join(lines).encode()).hexdigest()[:16]}  {lines[-1]}"


def _demo() -> Iterator[tuple[Image, Box]]:
    return ((shot.image, shot.box) for shot in render(4))


def _frames_of(sequence: Sequence) -> Callable[[], Iterator[tuple[Image, Box]]]:
    def frames() -> Iterator[tuple[Image, Box]]:
        return ((sequence.frame(i), tuple(sequence.boxes[i])) for i in range(len(sequence)))

    return frames


if __name__ == "__main__":
    tyro.cli(main)

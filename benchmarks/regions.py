"""Compare sides of the search crop on clips, at their own frame rate and at fractions of it.

    python benchmarks/regions.py MODEL --root CLIPS --sizes 256 224 192 [--strides 1 3] [--states]

A smaller crop shows a smaller region at the same scale: it is searched in less time, and a fast target leaves it
sooner. So each clip is also followed with only every N-th frame. Prints mean precision and AUC in the `otb` convention
for each stride and side. Behind each side but the first stands the difference from the first, with a 95 % bootstrap
interval over clips. Clips of fewer than five frames are left out. Choose a side on held-out clips.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import tyro

from psiamfcpp import datasets
from psiamfcpp.datasets import Sequence
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.differences import paired_difference
from psiamfcpp.evaluation.metrics import score_sequence
from psiamfcpp.evaluation.ope import one_pass
from psiamfcpp.trackers import TrackerOptions, open_tracker

Figures = dict[str, dict[str, float]]
"""figures of clips, by name"""

_FEWEST = 5


def main(
    model: tyro.conf.Positional[str],
    root: Path,
    sizes: tuple[int, ...],
    strides: tuple[int, ...] = (1, 3),
    states: bool = False,
    threads: int = 1,
) -> None:
    """Follow and print.

    Args:
        model: one of our models, as for `psiamfcpp track`.
        root: folder of sequences.
        sizes: sides of the search crop, pixels.
        strides: every how many frames of a clip are followed.
        states: follow with states, as by default elsewhere; without it, by the plain procedure.
        threads: threads of the tracker.
    """
    if not sizes:
        raise UserError("no side is given: give --sizes, as 256 224")
    if min(strides, default=0) < 1:
        raise UserError(f"stride {min(strides, default=0)} is none: give 1 or more")
    clips = datasets.read("folder", root)
    trackers = [
        open_tracker(model, TrackerOptions(threads=threads, plain=not states, search_size=size)) for size in sizes
    ]
    for stride in strides:
        thinned = [clip for clip in (_every(clip, stride) for clip in clips) if len(clip) >= _FEWEST]
        if not thinned:
            raise UserError(f"no clip in {root} has {_FEWEST} frames at stride {stride}")
        first: Figures | None = None
        for size, tracker in zip(sizes, trackers, strict=True):
            found = {clip.name: score_sequence(clip.boxes, one_pass(tracker, clip).boxes).figures for clip in thinned}
            parts = [_text(name, found, first) for name in ("precision", "auc")]
            print(f"stride {stride}, {size} pixels, {len(thinned)} clips: {', '.join(parts)}", flush=True)
            first = found if first is None else first


def _every(clip: Sequence, stride: int) -> Sequence:
    return dataclasses.replace(clip, frames=clip.frames[::stride], boxes=clip.boxes[::stride])


def _text(name: str, found: Figures, first: Figures | None) -> str:
    own = {clip: figures[name] for clip, figures in found.items()}
    text = f"{name} {np.mean(list(own.values())):.3f}"
    if first is None:
        return text
    change = paired_difference(own, {clip: figures[name] for clip, figures in first.items()})
    return f"{text} ({change.mean:+.3f} [{change.low:+.3f}, {change.high:+.3f}])"


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except UserError as error:
        print(f"regions.py: {error}", file=sys.stderr)
        sys.exit(2)

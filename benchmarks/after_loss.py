"""What trackers do after loss: the VOT long-term F-score on rendered long clips, with states and plain.

    python benchmarks/after_loss.py --trackers plightfc-int8 psiamfcpp-alexnet-n-int8 --seeds 1 3 5

The target leaves the frame, is hidden, and cars that look like it pass (`psiamfcpp.demo.long`). Precision at a limit of
the score is the mean overlap over the frames whose score reaches it, 0 where the target is out of sight; recall is the
mean over the frames in which the target is in sight, 0 where the score does not reach the limit. Both are means over
clips, and the F-score is the highest over all limits (Lukezic et al. 2018). Even seeds served to develop the states;
use odd ones to judge them. ``--curve FILE.png`` draws precision against recall; the extra ``report`` has matplotlib.

Times are those of updates on one thread, in milliseconds: the median of frames in which the target is surely seen
(``ms_sure``) and of the others (``ms_unsure``), where one more region is searched, and the worst of the others as a
multiple of the first (``worst``). Trackers that state nothing have ``ms_sure`` alone.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import tyro
from numpy.typing import NDArray

from psiamfcpp import TrackerOptions, open_tracker
from psiamfcpp.demo.long import render_long
from psiamfcpp.errors import UserError
from psiamfcpp.files import whole
from psiamfcpp.geometry import overlap

Frames = NDArray[np.float64]
"""``(n, 5)`` by frame: overlap, whether the target is in sight, score, whether it is surely seen, milliseconds"""

_LIMITS = 100


def main(
    trackers: tuple[str, ...] = ("plightfc-int8",),
    seeds: tuple[int, ...] = (1, 3, 5, 7, 9),
    frames: int = 600,
    curve: Path | None = None,
) -> None:
    """Follow and print one JSON object.

    Args:
        trackers: those that state scores, as `psiamfcpp.open_tracker` takes them.
        seeds: of the clips.
        frames: of each clip.
        curve: PNG image to draw precision against recall into, one line per tracker.
    """
    if curve:
        # Before all the work: without matplotlib nothing could be drawn at its end.
        import matplotlib  # noqa: F401

        if not curve.parent.is_dir():
            raise UserError(f"folder {curve.parent} is not there: make it, or give another --curve")
    cv2.setNumThreads(1)
    found: dict[str, list[Frames]] = {}
    for seed in seeds:
        for name, rows in follow(trackers, seed, frames):
            found.setdefault(name, []).append(rows)
    if curve:
        draw(found, curve)
    print(json.dumps({"seeds": seeds, "frames": frames, "trackers": {k: table(v) for k, v in found.items()}}))


def follow(trackers: tuple[str, ...], seed: int, frames: int) -> Iterator[tuple[str, Frames]]:
    """Yield what each tracker does on one clip, with states and plain."""
    names = [f"{name} {way}" for name in trackers for way in ("states", "plain")]
    opened = [
        open_tracker(name, TrackerOptions(threads=1, plain=plain)) for name in trackers for plain in (False, True)
    ]
    rows = np.zeros((len(names), frames - 1, 5))
    clip = render_long(seed, frames)
    first = next(clip)
    for tracker in opened:
        tracker.init(first.image, first.box)
    for number, frame in enumerate(clip):
        for row, tracker in zip(rows, opened, strict=True):
            began = time.perf_counter()
            track = tracker.update(frame.image)
            ms = 1e3 * (time.perf_counter() - began)
            seen, sure = overlap(track.box, frame.box) * frame.visible, track.state in (None, "tracking")
            row[number] = seen, frame.visible, track.score or 0.0, sure, ms
    for tracker in opened:
        tracker.close()
    yield from zip(names, rows, strict=True)


def points_of(clips: list[Frames]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return limits of the score ``(n,)``, and the mean precision and recall ``(2, n)`` of clips at each."""
    limits = np.unique(np.quantile(np.concatenate([rows[:, 2] for rows in clips]), np.linspace(0, 1, _LIMITS)))
    return limits, np.mean([precision_recall(rows, limits) for rows in clips], axis=0)


def f_scores(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the F-score ``(n,)`` of precision and recall ``(2, n)``."""
    return np.asarray(2 * points[0] * points[1] / np.maximum(points[0] + points[1], 1e-9))


def table(clips: list[Frames]) -> dict[str, object]:
    """Return the F-score of several clips with its precision and recall, and the recall whatever the score."""
    limits, points = points_of(clips)
    f = f_scores(points)
    best = int(f.argmax())
    names = ("f", "precision", "recall", "recall_of_all", "score")
    values = (f[best], points[0, best], points[1, best], points[1, 0], limits[best])
    row: dict[str, object] = {name: round(float(value), 3) for name, value in zip(names, values, strict=True)}
    return row | times(np.concatenate(clips))


def draw(found: dict[str, list[Frames]], image: Path) -> None:
    """Draw precision against recall, a line per tracker and a dot where the F-score is highest.

    Raises:
        UserError: the image cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(5.5, 4), layout="constrained")
    for number, (name, clips) in enumerate(found.items()):
        _, points = points_of(clips)
        # Rows come in pairs, with states and plain.
        colour, style = f"C{number // 2}", "-" if number % 2 == 0 else "--"
        best = [int(f_scores(points).argmax())]
        axes.plot(points[1], points[0], style, color=colour, label=name, markevery=best, marker="o")
    axes.set(xlabel="recall", ylabel="precision", xlim=(0, None), ylim=(0, 1))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    with whole(image) as temporary:
        figure.savefig(temporary, format="png", dpi=100)
    plt.close(figure)


def times(rows: Frames) -> dict[str, object]:
    """Return milliseconds of an update in sure frames and in others, and the worst of the others over the first."""
    sure, ms = rows[:, 3] > 0, rows[:, 4]
    if sure.all() or not sure.any():
        return {"ms_sure": round(float(np.median(ms)), 2)} if sure.all() else {}
    usual, others = float(np.median(ms[sure])), ms[~sure]
    found = {"ms_sure": usual, "ms_unsure": float(np.median(others)), "worst": float(others.max()) / usual}
    return {name: round(value, 2) for name, value in found.items()}


def precision_recall(rows: Frames, limits: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return precision and recall ``(2, n)`` of one clip at each limit of the score."""
    overlaps, seen, scores = rows.T[:3]
    reached = scores >= limits[:, None]
    total = (reached * overlaps).sum(axis=1)
    return np.stack(
        [np.where(reached.any(axis=1), total / np.maximum(reached.sum(axis=1), 1), 1.0), total / seen.sum()]
    )


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except (UserError, ModuleNotFoundError) as error:
        print(f"after_loss.py: {error}", file=sys.stderr)
        sys.exit(2)

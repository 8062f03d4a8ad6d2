"""Measure what `track` costs beside its tracker: video in and out against the tracker alone, on one thread.

    python benchmarks/following.py --models psiamfcpp-alexnet-int8 psiamfcpp-alexnet-n-int8

Writes the demo clip as H.264 at 1280x720. Then, round by round: follows its frames in memory (``alone``), follows the
file and writes a video (``files``), and encodes the frames without a tracker (``encoder``, the limit of quick models).
Prints the median frames per second of each, and ``share``: files against alone.
"""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from collections.abc import Iterable
from itertools import islice, starmap
from pathlib import Path

import cv2
import tyro

from psiamfcpp import TargetPool, TrackerOptions
from psiamfcpp.demo.clip import render
from psiamfcpp.geometry import Box
from psiamfcpp.recipes.follow import Outputs, follow_to_files
from psiamfcpp.video.source import Image, open_source
from psiamfcpp.video.span import Shot
from psiamfcpp.video.threads import ahead
from psiamfcpp.video.writer import VideoWriter
from psiamfcpp.zoo import DEFAULT_MODEL

FPS = 30.0


def main(models: tuple[str, ...] = (DEFAULT_MODEL,), frames: int = 120, rounds: int = 3) -> None:
    """Measure and print one JSON object.

    Args:
        models: shipped models, or model files.
        frames: of the demo clip.
        rounds: how often each way is timed.
    """
    cv2.setNumThreads(1)
    shots = list(islice(render(0), frames))
    images, box = [shot.image for shot in shots], shots[0].box
    with tempfile.TemporaryDirectory() as folder:
        clip, output = Path(folder) / "clip.mp4", Path(folder) / "followed.mp4"
        encode(clip, images)
        rates = {model: {"alone": [], "files": [], "encoder": []} for model in models}
        for _ in range(rounds):
            for model, found in rates.items():
                found["alone"].append(alone(model, images, box))
                found["files"].append(through_files(model, clip, output, box))
                found["encoder"].append(encode(output, images))
    rows = {}
    for model, found in rates.items():
        median = {way: statistics.median(fps) for way, fps in found.items()}
        rows[model] = {way: round(fps, 1) for way, fps in median.items()}
        rows[model]["share"] = round(median["files"] / median["alone"], 3)
    print(json.dumps({"frames": frames, "size": images[0].shape[1::-1], "models": rows}, indent=2))


def alone(model: str, images: list[Image], box: Box) -> float:
    """Return the frames per second of the tracker on frames in memory."""
    pool = TargetPool(model, options=TrackerOptions(threads=1))
    pool.add(images[0], box)
    start = time.perf_counter()
    for image in images[1:]:
        pool.update(image)
    return (len(images) - 1) / (time.perf_counter() - start)


def through_files(model: str, clip: Path, output: Path, box: Box) -> float:
    """Return the frames per second of following a file and writing a video, as `track` does it."""
    pool = TargetPool(model, options=TrackerOptions(threads=1))
    start = time.perf_counter()
    with open_source(clip) as video, ahead(starmap(Shot, enumerate(video))) as read:
        result = follow_to_files(read, pool, [box], FPS, Outputs(output))
    return len(result.tracks) / (time.perf_counter() - start)


def encode(path: Path, images: Iterable[Image]) -> float:
    """Return the frames per second of writing a video alone."""
    images = list(images)
    start = time.perf_counter()
    with VideoWriter(path, FPS, (images[0].shape[1], images[0].shape[0])) as writer:
        for image in images:
            writer.write(image)
    return len(images) / (time.perf_counter() - start)


if __name__ == "__main__":
    tyro.cli(main)

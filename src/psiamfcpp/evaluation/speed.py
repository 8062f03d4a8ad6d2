"""Speed of trackers, measured in turn in one process so that what disturbs one disturbs all."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from psiamfcpp.geometry import Box, FloatArray, Image
from psiamfcpp.machine import cpu_flags, processor_name
from psiamfcpp.trackers.contract import Tracker
from psiamfcpp.trackers.siamfcpp import Tracker as OurTracker

# The machine is noisy if a fixed piece of work takes longer by more than this share in half of the rounds.
_NOISE = 0.1
# What decides how fast integers and floats are multiplied.
_FLAGS = ("avx2", "fma", "avx512f", "avx512_vnni", "avx_vnni", "avx512_bf16", "amx_int8", "asimd", "asimddp", "i8mm")


@dataclass(frozen=True)
class Step:
    """Seconds of one update."""

    crop: float
    graph: float
    decode: float

    @property
    def total(self) -> float:
        """The whole update."""
        return self.crop + self.graph + self.decode


@dataclass(frozen=True)
class Candidate:
    """A tracker to time, and how the table shows it."""

    model: str
    tracker: Tracker
    kind: str = ""
    """of another tracker than ours, as opencv or dcf"""

    @property
    def engine(self) -> str:
        """What runs the network; of other trackers their kind."""
        return self.tracker.engine.name if isinstance(self.tracker, OurTracker) else self.kind

    @property
    def device(self) -> str | None:
        """Where it computes, as cpu or cuda:0; None where the tracker does not say."""
        return self.tracker.engine.device if isinstance(self.tracker, OurTracker) else None

    @property
    def precision(self) -> str | None:
        """Number format: fp32, fp16 or int8; None where the tracker does not say."""
        return self.tracker.engine.precision if isinstance(self.tracker, OurTracker) else None

    def step(self, frame: Image) -> Step:
        """Find the target in the next frame, and time it.

        With our models the time is split into crop, network and the rest; of other trackers all of it counts as the
        network's.
        """
        tracker, start = self.tracker, time.perf_counter()
        if not isinstance(tracker, OurTracker):
            tracker.update(frame)
            return Step(0.0, time.perf_counter() - start, 0.0)
        engine, target = tracker.engine, tracker.following
        look = target.aim(frame)
        cropped = time.perf_counter()
        answer = engine.search(look.region, look.kernels)
        answered = time.perf_counter()
        target.conclude(frame, look, *answer, engine)
        return Step(cropped - start, answered - cropped, time.perf_counter() - answered)


@dataclass
class Timing:
    """Milliseconds of one candidate: one row per round, one column per update."""

    candidate: Candidate
    steps: list[list[Step]] = field(default_factory=list)

    def part(self, name: str) -> FloatArray:
        """``(rounds, updates)``: crop, graph, decode or total."""
        return np.array([[getattr(step, name) * 1e3 for step in steps] for steps in self.steps])

    def row(self, baseline: Timing | None) -> dict[str, Any]:
        """The figures, in the names that every user of ``bench --json`` relies on."""
        by_round = np.median(self.part("total"), axis=1)
        speedup = None
        if baseline is not None:
            # Round by round, since both met the same machine there.
            speedup = float(np.median(np.median(baseline.part("total"), axis=1) / by_round))
        return {
            "model": self.candidate.model,
            "engine": self.candidate.engine,
            "device": self.candidate.device,
            "precision": self.candidate.precision,
            "ms_median": float(np.median(by_round)),
            "ms_min": float(self.part("total").min()),
            "ms_spread": float(by_round.max() - by_round.min()),
            "crop_ms": float(np.median(self.part("crop"))),
            "graph_ms": float(np.median(self.part("graph"))),
            "decode_ms": float(np.median(self.part("decode"))),
            "speedup": speedup,
        }


@dataclass
class Bench:
    """Everything that was measured."""

    timings: list[Timing]
    reading: list[float] = field(default_factory=list)
    """milliseconds to decode a frame from JPEG, one a round"""
    reference: list[float] = field(default_factory=list)
    """milliseconds of a fixed piece of work, before each candidate of each round"""

    @property
    def noise(self) -> float:
        """By what share the slow half of the reference's runs is slower than its fastest run."""
        return float(np.median(self.reference) / np.min(self.reference) - 1)

    @property
    def noisy(self) -> bool:
        """Whether the figures are to be doubted."""
        return self.noise > _NOISE


def run(bench: Bench, frames: list[Image], box: Box, rounds: int) -> Iterator[Candidate]:
    """Time candidates in turn, round after round.

    Args:
        bench: where the measurements go.
        frames: ``(H, W, 3)`` uint8, BGR; every candidate follows the same target through all of them.
        box: the target on the first.
        rounds: how often.

    Yields:
        Each candidate of each round, once it is timed.
    """
    files = [cv2.imencode(".jpg", frame)[1] for frame in frames]
    for _ in range(rounds):
        start = time.perf_counter()
        for file in files:
            cv2.imdecode(file, cv2.IMREAD_COLOR)
        bench.reading.append((time.perf_counter() - start) * 1e3 / len(files))
        for timing in bench.timings:
            bench.reference.append(_fixed_work())
            timing.candidate.tracker.init(frames[0], box)
            timing.steps.append([timing.candidate.step(frame) for frame in frames[1:]])
            yield timing.candidate


def machine() -> dict[str, Any]:
    """The processor: its name, how many cores this process may use, and what it can do with many numbers at once."""
    flags = cpu_flags()
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {"cpu": processor_name(), "flags": [flag for flag in _FLAGS if flag in flags], "load": load}


def _fixed_work() -> float:
    """Milliseconds that Python takes to count: it is alike on every run unless somebody else computes."""
    best = []
    for _ in range(3):
        start = time.perf_counter()
        sum(range(200_000))
        best.append(time.perf_counter() - start)
    return float(np.median(best)) * 1e3

"""Speed of trackers, measured in turn in one process so that what disturbs one disturbs all."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box, FloatArray, Image
from psiamfcpp.machine import cpu_flags, processor_name
from psiamfcpp.tracking import Tracker

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


class Candidate(Protocol):
    """Something that follows a target and says where the time goes."""

    model: str
    engine: str
    precision: str

    def init(self, frame: Image, box: Box) -> None:
        """Take up a target."""
        ...

    def step(self, frame: Image) -> Step:
        """Find it in the next frame."""
        ...


class Ours:
    """A tracker of this package."""

    def __init__(self, model: str, engine: str, precision: str, threads: int):
        self.model, self.engine, self.precision = model, engine, precision
        self._tracker = Tracker(model, engine, threads, plain=True)

    def init(self, frame: Image, box: Box) -> None:
        """See `Candidate`."""
        self._tracker.init(frame, box)

    def step(self, frame: Image) -> Step:
        """See `Candidate`."""
        tracker, start = self._tracker, time.perf_counter()
        look = tracker.aim(frame)
        cropped = time.perf_counter()
        answer = tracker.engine.search(look.region, look.kernels)
        answered = time.perf_counter()
        tracker.conclude(frame, look, *answer)
        return Step(cropped - start, answered - cropped, time.perf_counter() - answered)


class Peer:
    """A tracker of OpenCV; all of its time counts as the graph's."""

    precision = "fp32"
    engine = "opencv"

    def __init__(self, model: str, create: Callable[[], Any]):
        self.model, self._create = model, create

    def init(self, frame: Image, box: Box) -> None:
        """See `Candidate`."""
        self._tracker = self._create()
        self._tracker.init(frame, tuple(round(v) for v in box))

    def step(self, frame: Image) -> Step:
        """See `Candidate`."""
        start = time.perf_counter()
        self._tracker.update(frame)
        return Step(0.0, time.perf_counter() - start, 0.0)


def peers(nano: tuple[Path, Path] | None, vit: Path | None) -> Iterator[Peer]:
    """Trackers that the installed OpenCV has.

    Args:
        nano: backbone and head of NanoTrack, for TrackerNano.
        vit: file of TrackerVit.

    Raises:
        UserError: a file is missing or not what the tracker needs.
    """
    for name in ("KCF", "CSRT", "MIL"):
        if hasattr(cv2, f"Tracker{name}_create"):
            yield Peer(name, getattr(cv2, f"Tracker{name}_create"))
    files: dict[str, dict[str, Path]] = {}
    if nano:
        files["TrackerNano"] = {"backbone": nano[0], "neckhead": nano[1]}
    if vit:
        files["TrackerVit"] = {"net": vit}
    for name, named in files.items():
        for path in named.values():
            if not path.is_file():
                raise UserError(f"{path} for {name} does not exist")
        try:
            settings = getattr(cv2, f"{name}_Params")()
            for key, path in named.items():
                setattr(settings, key, str(path))
            create = getattr(cv2, f"{name}_create")
            create(settings)
        except (AttributeError, cv2.error) as error:
            raise UserError(f"{name} cannot be made from {', '.join(map(str, named.values()))}: {error}") from None
        yield Peer(name, lambda create=create, settings=settings: create(settings))  # type: ignore[misc]


@dataclass
class Timing:
    """Milliseconds of one candidate, a row a round and a column an update."""

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


def run(bench: Bench, frames: list[Image], box: Box, rounds: int, advance: Callable[[], None] = lambda: None) -> None:
    """Time candidates in turn, round after round.

    Args:
        bench: where the measurements go.
        frames: ``(H, W, 3)`` uint8, BGR; every candidate follows the same target through all of them.
        box: the target on the first.
        rounds: how often.
        advance: called after each candidate of each round.
    """
    files = [cv2.imencode(".jpg", frame)[1] for frame in frames]
    for _ in range(rounds):
        start = time.perf_counter()
        for file in files:
            cv2.imdecode(file, cv2.IMREAD_COLOR)
        bench.reading.append((time.perf_counter() - start) * 1e3 / len(files))
        for timing in bench.timings:
            bench.reference.append(_fixed_work())
            timing.candidate.init(frames[0], box)
            timing.steps.append([timing.candidate.step(frame) for frame in frames[1:]])
            advance()


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

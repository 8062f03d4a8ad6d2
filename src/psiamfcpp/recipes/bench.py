"""Time models, engines, devices and other trackers in turn."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import cv2

from psiamfcpp.datasets import folder
from psiamfcpp.demo.clip import render
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation import speed
from psiamfcpp.geometry import Box, Image
from psiamfcpp.runtime import ENGINES, runs, usable_cores
from psiamfcpp.runtime.device import parse_device
from psiamfcpp.runtime.opening import KINDS, forms
from psiamfcpp.trackers import TrackerOptions, choose
from psiamfcpp.trackers.siamfcpp import Tracker
from psiamfcpp.watch import QUIET, Watch
from psiamfcpp.zoo import graph_names, names

# What all speeds are compared with: the unpruned network in torch on the processor.
BASELINE = ("siamfcpp-alexnet", "torch", "cpu")


@dataclass(frozen=True)
class BenchResult:
    """What was timed, and under what conditions."""

    rows: list[dict[str, Any]]
    """of each candidate: model, engine, device, precision, ms_median, ms_min, ms_spread, crop_ms, graph_ms, decode_ms,
    speedup (None without the baseline)"""
    facts: dict[str, Any]
    """cpu, flags, load, threads, frame_size (width, height), rounds, read_ms, noise, noisy"""

    @property
    def processors(self) -> list[dict[str, Any]]:
        """The columns of the paper's Table 3: ``fps_cpu`` and ``fps_gpu`` of each of our models on its fastest engine.

        None where a model was not timed on such a device.
        """
        best: dict[str, dict[str, Any]] = {}
        for row in self.rows:
            if row["engine"] in ENGINES:
                found = best.setdefault(row["model"], {"model": row["model"], "fps_cpu": None, "fps_gpu": None})
                key = "fps_cpu" if row["device"] == "cpu" else "fps_gpu"
                found[key] = max(1e3 / row["ms_median"], found[key] or 0.0)
        return list(best.values())


def bench(
    models: Sequence[str] = (),
    engines: Sequence[str] = (),
    devices: Sequence[str] = (),
    threads: int | None = None,
    rounds: int = 5,
    frames: int = 30,
    sequence: str | Path | None = None,
    trackers: Sequence[str] = ("opencv:mil",),
    watch: Watch = QUIET,
) -> BenchResult:
    """Time whole updates, and where their time goes: all candidates in turn, round after round, in one process.

    Args:
        models: shipped models, checkpoints or folders of graphs; by default all that are shipped.
        engines: what to run them on, where it can; by default all that are installed.
        devices: cpu, cuda or tensorrt, with the GPU's number as in cuda:1; by default cpu, and cuda where the
            installed torch or onnxruntime has it.
        threads: threads of every engine; by default one per usable core.
        rounds: how often each is timed.
        frames: updates per round.
        sequence: folder with img/ and groundtruth_rect.txt to follow; by default a rendered 720p clip.
        trackers: others to time beside them, as of `psiamfcpp.open_tracker`.
        watch: receives progress, and one line about what is left out.

    Raises:
        UserError: an option is out of range, a model, engine, device or tracker cannot be opened, or nothing of what
            is asked for goes together.
    """
    _check(engines, devices, threads, rounds, frames)
    threads = threads or usable_cores()
    others = [choose(entry, TrackerOptions(threads=threads)) for entry in trackers]
    candidates = _ours(models, engines, devices, threads, watch)
    candidates += [speed.Candidate(choice.name, choice.open(), choice.kind) for choice in others]
    # Not before all could be opened: rendering takes seconds.
    shots, box = _shots(sequence, frames)
    cv2.setNumThreads(threads)
    measured = speed.Bench([speed.Timing(candidate) for candidate in candidates])
    for _ in watch.track(speed.run(measured, shots, box, rounds), "timings", rounds * len(candidates)):
        pass
    base = next((t for t in measured.timings if _place(t.candidate) == BASELINE), None)
    facts = {**speed.machine(), "threads": threads, "frame_size": [shots[0].shape[1], shots[0].shape[0]]}
    facts |= {"rounds": rounds, "read_ms": sorted(measured.reading)[rounds // 2]}
    facts |= {"noise": measured.noise, "noisy": measured.noisy}
    return BenchResult([timing.row(base) for timing in measured.timings], facts)


def _check(engines: Sequence[str], devices: Sequence[str], threads: int | None, rounds: int, frames: int) -> None:
    if rounds < 1 or frames < 1:
        raise UserError(f"rounds is {rounds} and frames {frames}: both must be at least 1")
    if threads is not None and threads < 1:
        raise UserError(f"threads is {threads}: it must be at least 1")
    for engine in engines:
        if engine not in ENGINES:
            raise UserError(f"unknown engine {engine!r}: known are {', '.join(ENGINES)}")
    for device in devices:
        parse_device(device)


def usable_devices() -> list[str]:
    """Return cpu, and cuda where the installed torch finds a GPU or the installed onnxruntime is built for one."""
    import onnxruntime

    found = "CUDAExecutionProvider" in onnxruntime.get_available_providers()
    if not found and importlib.util.find_spec("torch"):
        import torch

        found = torch.cuda.is_available()
    return ["cpu", "cuda"] if found else ["cpu"]


def _place(candidate: speed.Candidate) -> tuple[str, str, str | None]:
    return candidate.model, candidate.engine, candidate.device


def _ours(
    models: Sequence[str], engines: Sequence[str], devices: Sequence[str], threads: int, watch: Watch
) -> list[speed.Candidate]:
    """Return every model, engine and device that go together; the baseline first."""
    found: list[speed.Candidate] = []
    # A reason may hold for many models: each is said once.
    left_out: dict[str, None] = {}
    for model, engine, device in _wanted(models, engines, devices):
        if not runs(engine, model):
            continue
        try:
            ours = Tracker(model, options=TrackerOptions(engine, device, threads, plain=True))
        except UserError as error:
            # What was asked for by name must be there; what is only tried may be missing.
            asked = model in models and device in (*devices, "cpu")
            if asked and (engine in engines or "pip install" not in str(error)):
                raise
            left_out[str(error)] = None
            continue
        if ours.engine.device != "cpu" and ours.engine.precision == "int8":
            left_out[f"{model} on {device}: 8-bit graphs are made for processors, time the float model there"] = None
        else:
            found.append(speed.Candidate(model, ours))
    for reason in left_out:
        watch.note(f"left out: {reason}")
    if not found:
        raise UserError(next(iter(left_out), f"no model and engine go together: {forms()}"))
    return found


def _wanted(models: Sequence[str], engines: Sequence[str], devices: Sequence[str]) -> Iterator[tuple[str, str, str]]:
    """Yield model, engine and device to try, the baseline first where it is among them."""
    pairs = product(models or sorted({*names(), *graph_names()}), engines or ENGINES, devices or usable_devices())
    wanted = [t for t in pairs if parse_device(t[2]).kind in KINDS[t[1]].devices]
    if BASELINE in wanted or not (engines or devices):
        yield BASELINE
    yield from (triple for triple in wanted if triple != BASELINE)


def _shots(sequence: str | Path | None, frames: int) -> tuple[list[Image], Box]:
    if sequence is None:
        clip = list(render(0, frames + 1))
        return [shot.image for shot in clip], clip[0].box
    found = folder.read(Path(sequence))[0]
    if len(found) <= frames:
        raise UserError(f"{sequence} holds {len(found)} frames: --frames {frames} needs one more than that")
    x, y, w, h = (float(v) for v in found.boxes[0])
    return [found.frame(i) for i in range(frames + 1)], (x, y, w, h)

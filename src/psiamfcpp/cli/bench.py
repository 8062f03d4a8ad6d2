"""`psiamfcpp bench`."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import cv2

from psiamfcpp.cli.arguments import Json
from psiamfcpp.cli.output import notes, print_json, progress
from psiamfcpp.datasets import folder
from psiamfcpp.demo.clip import render
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation import speed
from psiamfcpp.geometry import Box, Image
from psiamfcpp.runtime import ENGINES, runs, usable_cores
from psiamfcpp.runtime.graph_file import precision
from psiamfcpp.runtime.opening import forms
from psiamfcpp.trackers import TrackerOptions, choose
from psiamfcpp.trackers.siamfcpp import Tracker
from psiamfcpp.zoo import graph_folder, graph_names, names

# What all speeds are compared with: the unpruned network in torch.
BASELINE = ("siamfcpp-alexnet", "torch")


def bench(
    models: tuple[str, ...] = (),
    engines: tuple[str, ...] = (),
    threads: int | None = None,
    rounds: int = 5,
    frames: int = 30,
    sequence: Path | None = None,
    tracker: tuple[str, ...] = ("opencv:mil",),
    json: Json = False,
) -> None:
    """Time models on engines, and peers, in turn in one process: whole updates, and where their time goes.

    Args:
        models: shipped models, checkpoints or folders of graphs; by default all that are shipped.
        engines: what to run them on, where it can; by default all that are installed.
        threads: threads of every engine; by default all cores.
        rounds: how often each is timed.
        frames: updates a round.
        sequence: folder with img/ and groundtruth_rect.txt to follow; by default a rendered 720p clip.
        tracker: others to time beside them, as opencv:mil, opencv:nano,backbone=FILE,neckhead=FILE or dcf:kcf.
    """
    if rounds < 1 or frames < 1:
        raise UserError(f"rounds is {rounds} and frames {frames}: both must be at least 1")
    if threads is not None and threads < 1:
        raise UserError(f"threads is {threads}: it must be at least 1")
    for engine in engines:
        if engine not in ENGINES:
            raise UserError(f"unknown engine {engine!r}: known are {', '.join(ENGINES)}")
    threads = threads or usable_cores()
    others = [choose(entry, TrackerOptions(threads=threads)) for entry in tracker]
    candidates = list(_ours(models, engines, threads))
    candidates += [speed.Candidate(c.name, c.kind, None, c.open()) for c in others]
    shots, box = _shots(sequence, frames)
    cv2.setNumThreads(threads)
    measured = speed.Bench([speed.Timing(candidate) for candidate in candidates])
    with progress() as bar:
        task = bar.add_task("rounds", total=rounds * len(candidates))
        speed.run(measured, shots, box, rounds, lambda: bar.advance(task))
    base = next((t for t in measured.timings if (t.candidate.model, t.candidate.engine) == BASELINE), None)
    rows = [timing.row(base) for timing in measured.timings]
    facts = {**speed.machine(), "threads": threads, "frame_size": [shots[0].shape[1], shots[0].shape[0]]}
    facts |= {"rounds": rounds, "read_ms": sorted(measured.reading)[rounds // 2]}
    facts |= {"noise": measured.noise, "noisy": measured.noisy}
    if measured.noisy:
        notes.print(f"the machine was busy: a fixed piece of work took {measured.noise:.0%} longer than at its fastest")
    if json:
        print_json({"rows": rows, **facts})
    else:
        _print(rows, facts)


def _ours(models: tuple[str, ...], engines: tuple[str, ...], threads: int) -> list[speed.Candidate]:
    """Every pair of model and engine that goes together; the baseline first."""
    wanted = list(product(models or sorted({*names(), *graph_names()}), engines or ENGINES))
    if BASELINE in wanted or not engines:
        wanted = [BASELINE, *(pair for pair in wanted if pair != BASELINE)]
    found, refusals = [], []
    for model, engine in wanted:
        if not runs(engine, model):
            continue
        graphs = graph_folder(model)
        kind = "fp32" if engine == "torch" or graphs is None else precision(graphs)
        try:
            ours = Tracker(model, options=TrackerOptions(engine, threads=threads, plain=True))
            found.append(speed.Candidate(model, engine, kind, ours))
        except UserError as error:
            # What was asked for by name must be there; what is only tried may be missing.
            if model in models and (engine in engines or "pip install" not in str(error)):
                raise
            refusals.append(str(error))
    for refusal in sorted(set(refusals)):
        notes.print(f"left out: {refusal}")
    if not found:
        raise UserError(f"no model and engine go together: {forms()}")
    return found


def _shots(sequence: Path | None, frames: int) -> tuple[list[Image], Box]:
    if sequence is None:
        clip = list(render(0, frames + 1))
        return [shot.image for shot in clip], clip[0].box
    found = folder.read(sequence)[0]
    if len(found) <= frames:
        raise UserError(f"{sequence} holds {len(found)} frames: --frames {frames} needs one more than that")
    x, y, w, h = (float(v) for v in found.boxes[0])
    return [found.frame(i) for i in range(frames + 1)], (x, y, w, h)


def _print(rows: list[dict[str, Any]], facts: dict[str, Any]) -> None:
    print(f"{facts['cpu']}, {facts['threads']} threads, {' '.join(facts['flags'])}")
    print(f"frames of {facts['frame_size'][0]}x{facts['frame_size'][1]}; decoding one takes {facts['read_ms']:.1f} ms")
    titles = f"{'ms':>7} {'+-':>5} {'min':>6} {'crop':>5} {'graph':>6} {'decode':>6} speedup"
    print(f"{'model':26} {'engine':9} {'':5} {titles}")
    for row in rows:
        gain = f"{row['speedup']:.2f}x" if row["speedup"] else ""
        print(
            f"{row['model']:26} {row['engine']:9} {row['precision'] or '':5} {row['ms_median']:7.2f} "
            f"{row['ms_spread']:5.2f} {row['ms_min']:6.2f} {row['crop_ms']:5.2f} {row['graph_ms']:6.2f} "
            f"{row['decode_ms']:6.2f} {gain}"
        )

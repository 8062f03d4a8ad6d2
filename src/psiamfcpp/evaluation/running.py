"""Run trackers over a benchmark: one folder per tracker, one result file and one timing file per sequence.

``<results>/<dataset>/<tracker>/`` holds ``run.json``, ``<sequence>.txt`` (one ``x,y,w,h`` per line) and
``<sequence>_time.txt`` (seconds of tracking and of decoding a line). What is there and whole is not done again.
"""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from psiamfcpp.datasets import Sequence
from psiamfcpp.datasets.boxes import find_files, read_boxes, write_boxes
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.ope import first_label, one_pass
from psiamfcpp.evaluation.results import Files, read_times
from psiamfcpp.files import read_json, write_whole
from psiamfcpp.machine import processor_name
from psiamfcpp.trackers import Tracker, TrackerChoice
from psiamfcpp.version import __version__
from psiamfcpp.watch import QUIET, Watch

RUN_FILE = "run.json"
CONDITIONS = ("threads", "jobs", "processor")
"""what measured speeds depend on"""
_FORMAT = "psiamfcpp-run/1"
# What each entry may be.
_RUN: dict[str, tuple[type, ...]] = {
    "format": (str,),
    "tracker": (str,),
    "dataset": (str,),
    "root": (str,),
    "identity": (dict,),
    "threads": (int, type(None)),
    "jobs": (int,),
    "processor": (str,),
}


@dataclass(frozen=True)
class Job:
    """One tracker on one sequence."""

    choice: TrackerChoice
    folder: Path
    """the tracker's folder of results"""
    sequence: Sequence


def run(
    choices: list[TrackerChoice],
    dataset: str,
    root: Path,
    sequences: list[Sequence],
    results: Path,
    jobs: int = 1,
    cluster: str | None = None,
    watch: Watch = QUIET,
) -> list[str]:
    """Run trackers over sequences, and leave a result file for each pair that can be run.

    Args:
        choices: the trackers.
        dataset: name of the benchmark, and of the folder in ``results``.
        root: where its frames are; a report finds labels and frames again by it.
        sequences: what to run over.
        results: folder of results; what it holds already is kept.
        jobs: sequences that are run side by side, in as many processes.
        cluster: instead of processes here, the workers of a Dask scheduler (``tcp://host:port``); they must see the
            same files under the same names.
        watch: receives progress over what is not done yet.

    Returns:
        What went wrong: one line per pair that has no result.

    Raises:
        UserError: a tracker cannot be opened, two have one name, the folder holds another tracker's results under a
            name, or the cluster cannot be reached.
    """
    _check_names([choice.name for choice in choices], "trackers", "evaluate them into two folders")
    _check_names([sequence.name for sequence in sequences], "sequences", "rename one")
    choices = [_with_threads(choice, jobs, cluster) for choice in choices]
    # whole paths, since workers may have another working directory
    folders = {choice: results.resolve() / dataset / choice.name for choice in choices}
    earlier = {choice: _check_run(folder, choice) for choice, folder in folders.items()}
    pending = [Job(c, folder, s) for c, folder in folders.items() for s in sequences if not is_done(folder, s)]
    for choice in {job.choice: None for job in pending}:
        # before anything is written: a tracker that cannot be opened leaves nothing behind
        choice.open().close()
    for choice, folder in folders.items():
        new = any(job.choice == choice for job in pending)
        before = earlier[choice]
        conditions = _conditions(choice, jobs, before) if new or before is None else {k: before[k] for k in CONDITIONS}
        write_whole(folder / RUN_FILE, _describe(choice, dataset, root, conditions))
    done = _in_parallel(pending, jobs, cluster) if jobs > 1 or cluster else _one_by_one(pending)
    return [problem for problem in watch.track(done, "sequences", len(pending)) if problem]


def is_done(folder: Path, sequence: Sequence) -> bool:
    """Whether a tracker's folder holds a whole result of the sequence as it is, with its times."""
    try:
        boxes = read_boxes(folder / f"{sequence.name}.txt")
        times = read_times(folder / f"{sequence.name}_time.txt")
        start = first_label(sequence)
    except UserError:
        return False
    # a sequence whose labels were corrected is another one
    return len(boxes) == len(times) == len(sequence) and np.allclose(boxes[start], sequence.boxes[start], atol=1e-3)


def result_files(folder: Path, sequences: list[Sequence]) -> Files:
    """The result files of a tracker's folder that are whole, by sequence."""
    return {s.name: folder / f"{s.name}.txt" for s in sequences if is_done(folder, s)}


def read_run(folder: Path) -> dict[str, Any] | None:
    """What `run` wrote of a tracker; None in a folder of other origin.

    Raises:
        UserError: the file is damaged.
    """
    path = folder / RUN_FILE
    if not path.exists():
        return None
    fix = "remove its folder and run the tracker again"
    found = read_json(path, "run", fix)
    told = found if isinstance(found, dict) else {}
    wrong = [key for key, kinds in _RUN.items() if key not in told or type(told[key]) not in kinds]
    if wrong or found["format"] != _FORMAT:
        raise UserError(f"run {path} is damaged, or of another version ({', '.join(wrong) or 'format'}): {fix}")
    return {key: found[key] for key in _RUN if key != "format"}


def _one_by_one(pending: list[Job]) -> Iterator[str | None]:
    opened: tuple[TrackerChoice, Tracker] | None = None
    for job in pending:
        if opened is None or opened[0] != job.choice:
            opened = (job.choice, job.choice.open())
        yield _attempt(opened[1], job)


def _in_parallel(pending: list[Job], jobs: int, cluster: str | None) -> Iterator[str | None]:
    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    with _workers(cluster) if cluster else contextlib.nullcontext():
        # joblib cannot hand out a cluster's results before the last
        order = "list" if cluster else "generator_unordered"
        parallel = Parallel(n_jobs=-1 if cluster else jobs, batch_size=1, return_as=order)
        try:
            yield from parallel(delayed(_attempt_in_worker)(job, None if cluster else os.getpid()) for job in pending)
        except TerminatedWorkerError:
            text = "a process that ran sequences was killed, perhaps for memory"
            raise UserError(f"{text}: give fewer --jobs; what was done with --results stays") from None


@contextlib.contextmanager
def _workers(address: str) -> Iterator[None]:
    """Let joblib send its work to a cluster."""
    from joblib import parallel_config

    try:
        from dask.distributed import Client
    except ModuleNotFoundError:
        raise UserError("a Dask cluster needs Dask: pip install 'dask[distributed]'") from None
    try:
        client = Client(address, timeout="60s")
    except (OSError, ValueError) as error:
        raise UserError(f"no Dask scheduler answers at {address} ({error}): give tcp://host:port") from None
    with client, parallel_config(backend="dask"):
        yield


_mine = threading.local()
"""the tracker that a worker has opened; one a thread, since Dask's workers may have several and trackers have state"""


def _attempt_in_worker(job: Job, parent: int | None) -> str | None:
    if parent is not None and not hasattr(_mine, "watch"):
        _mine.watch = threading.Thread(target=_end_with, args=(parent,), daemon=True)
        _mine.watch.start()
    if getattr(_mine, "choice", None) != job.choice:
        _mine.tracker, _mine.choice = job.choice.open(), job.choice
    return _attempt(_mine.tracker, job)


def _end_with(parent: int) -> None:
    """End this process soon after the one that started it: killed, that one cannot stop its workers any more."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def _attempt(tracker: Tracker, job: Job) -> str | None:
    """Run one sequence and write it down; what went wrong, if anything did."""
    name = job.sequence.name
    try:
        done = one_pass(tracker, job.sequence)
        # the times first: a result stands for a sequence that is done
        times = zip(done.seconds, done.decoding, strict=True)
        write_whole(job.folder / f"{name}_time.txt", "".join(f"{t:.6f},{d:.6f}\n" for t, d in times))
        write_boxes(job.folder / f"{name}.txt", done.boxes)
    except UserError as error:
        # what a foreign class raises may have many lines
        return " ".join(f"{job.choice.name} on sequence {name}: {error}".split())
    return None


def _with_threads(choice: TrackerChoice, jobs: int, cluster: str | None) -> TrackerChoice:
    """The same with its threads settled: what is said of them later must be true, and jobs share the cores."""
    if choice.options.threads is not None:
        return choice
    from joblib import cpu_count

    given = os.environ.get("OMP_NUM_THREADS", "")
    threads = int(given) if given.isdecimal() and int(given) else 1 if cluster else max(1, cpu_count() // jobs)
    return replace(choice, options=replace(choice.options, threads=threads))


def _check_names(names: list[str], what: str, fix: str) -> None:
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UserError(f"two {what} are called {twice}: {fix}")


def _check_run(folder: Path, choice: TrackerChoice) -> dict[str, Any] | None:
    """What is known of an earlier run into the folder, if it was of the same tracker."""
    earlier = read_run(folder)
    if earlier is None and folder.is_dir() and find_files(folder, "*.txt"):
        raise UserError(f"{folder} holds results of another origin: give another folder of results")
    if earlier is not None and earlier["identity"] != choice.identity():
        before, now = earlier["identity"], choice.identity()
        keys = [key for key in {**before, **now} if before.get(key) != now.get(key)]
        how = ", ".join(f"{key} {before.get(key)} and not {now.get(key)}" for key in keys)
        raise UserError(f"{folder} was made with {how}: give another folder of results, or remove it")
    return earlier


def _describe(choice: TrackerChoice, dataset: str, root: Path, conditions: dict[str, Any]) -> str:
    facts = {
        "format": _FORMAT,
        "tracker": choice.name,
        "dataset": dataset,
        "root": str(root.resolve()),
        "identity": choice.identity(),
        **conditions,
        "version": __version__,
    }
    return json.dumps(facts, indent=2) + "\n"


def _conditions(choice: TrackerChoice, jobs: int, earlier: dict[str, Any] | None) -> dict[str, Any]:
    """Under what conditions the times were measured, those of an earlier run included."""
    # how many threads a foreign class uses, nobody here knows
    threads = None if choice.kind == "module" else choice.options.threads
    processor = processor_name()
    if earlier is None:
        return {"threads": threads, "jobs": jobs, "processor": processor}
    return {
        # where runs differed there is no number to state
        "threads": threads if earlier["threads"] == threads else None,
        "jobs": max(jobs, earlier["jobs"]),
        "processor": " and ".join(dict.fromkeys([earlier["processor"], processor])),
    }

"""Boxes that trackers left behind, in the layouts in which others publish them.

A folder of results holds one tracker's sequences, or one folder per tracker. A sequence is

* ``<sequence>.txt``: one box per line, separated by commas, tabs or blanks (pysot, the GOT-10k toolkit, this package);
* ``<sequence>/<sequence>_001.txt``: results on GOT-10k itself;
* ``<sequence>.mat`` or ``<sequence>_<tracker>.mat``: the toolkits of OTB, UAV123 and the correlation filters.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from psiamfcpp.datasets.boxes import read_boxes
from psiamfcpp.errors import UserError, brief
from psiamfcpp.evaluation.matlab import read_variable
from psiamfcpp.evaluation.metrics import Convention, Scores, score_sequence
from psiamfcpp.files import read_bytes, read_text
from psiamfcpp.geometry import FloatArray

Files = dict[str, Path]
"""result files by sequence"""
Counted = Callable[[FloatArray], FloatArray]


def find(folder: Path, dataset: Collection[str], sequences: Iterable[str]) -> dict[str, Files]:
    """The trackers of a folder, by name, each with its result files.

    Args:
        folder: one tracker's folder, or one that holds one folder per tracker; of these, those without a result of
            these sequences come with no file.
        dataset: names of the benchmark: a folder of such a name, above or below the trackers', is looked into.
        sequences: names of the benchmark's sequences; in the names of files, capitals do not matter, nor do the
            signs between words.

    Raises:
        UserError: the folder is missing, or holds no result of these sequences.
    """
    if not folder.is_dir():
        raise UserError(f"results folder {folder} does not exist")
    listed = list(sequences)
    # A link keeps its own name; "." and ".." have none.
    own = folder.name if folder.name not in ("", "..") else folder.resolve().name
    names = {_key(name): name for name in listed} | {name: name for name in listed}
    for place in _with_dataset(folder, dataset):
        found = _trackers(place, own, names)
        if not found:
            for child in _subfolders(place):
                inner = [_trackers(path, child.name, names) for path in _with_dataset(child, dataset)]
                found |= next(filter(None, inner), {child.name: {}})
        if any(found.values()):
            return found
    wanted = f"{listed[0]}.txt, {listed[0]}/{listed[0]}_001.txt or {listed[0]}.mat" if listed else "a sequence"
    raise UserError(
        f"{folder} holds no result of the labelled sequences; expected is {wanted}, in one folder per tracker"
    )


def find_all(folders: Iterable[Path], dataset: Collection[str], sequences: Collection[str]) -> dict[str, Files]:
    """The trackers of several folders; see `find`.

    Raises:
        UserError: as `find`, or two folders hold a tracker of one name.
    """
    trackers: dict[str, Files] = {}
    for folder in folders:
        for name, files in find(folder, dataset, sequences).items():
            if name in trackers:
                raise UserError(f"{folder} holds a second tracker called {name}: rename its folder")
            trackers[name] = files
    return trackers


def without_result(tracker: str, files: Files, sequences: Collection[str], allow: bool) -> dict[str, str]:
    """Return why sequences do not count, by name: those that a tracker has no result of.

    Raises:
        UserError: it lacks one, and that is not allowed; names the first.
    """
    missing = [name for name in sequences if name not in files]
    if missing and not allow:
        raise UserError(
            f"tracker {tracker} lacks {len(missing)} of {len(sequences)} sequences, the first is {missing[0]}: "
            "add its result, or give --allow-missing"
        )
    return dict.fromkeys(missing, "no result")


@dataclass(frozen=True)
class Speed:
    """Frames a second over all sequences, decoding apart."""

    median: float
    """of the single frames"""
    mean: float
    """frames by time"""


def read_speed(files: Files) -> Speed | None:
    """Speed from the files of times, ``<sequence>_time.txt``; the first frame does not count.

    They lie beside the results, or in a folder ``times`` there, as the GOT-10k toolkit leaves them for OTB and UAV123.
    None where a sequence has no such file, or the times in it are no times.

    Raises:
        UserError: a file of times is damaged.
    """
    updates: list[FloatArray] = []
    for name, path in files.items():
        places = (path.with_name(f"{name}_time.txt"), path.parent / "times" / f"{name}_time.txt")
        found = next((place for place in places if place.is_file()), None)
        if found is None:
            return None
        seconds = read_times(found)
        # before the first label there is no time; the first there is, is that of init
        updates.append(seconds[np.isfinite(seconds)][1:])
    together = np.concatenate(updates) if updates else np.empty(0)
    if not len(together) or not (together > 0).all():
        return None
    return Speed(float(1 / np.median(together)), float(1 / together.mean()))


def read_times(path: Path) -> FloatArray:
    """Seconds ``(n,)`` of tracking from a file of times, the first number of each line.

    Raises:
        UserError: the file is missing, or a line holds no number.
    """
    lines = read_text(path, "times", "run the tracker again").splitlines()
    try:
        return np.array([float(line.replace(",", " ").split()[0]) for line in lines])
    except (ValueError, IndexError) as error:
        raise UserError(f"times {path} cannot be read ({brief(error)}): run the tracker again") from None


def read_result(path: Path, rows: int, counted: Counted = lambda boxes: boxes) -> FloatArray:
    """Boxes ``(rows, 4)`` of a result file; those that are NaN or have no area stay so.

    Args:
        path: the file.
        rows: number of labels.
        counted: gives the rows that count of a result with a row for each frame, see `Benchmark.counted`.

    Raises:
        UserError: the file cannot be read, holds anything but four numbers a row, or has another number of rows.
    """
    boxes = counted(_read_mat(path) if path.suffix == ".mat" else read_boxes(path))
    if len(boxes) != rows:
        problem = f"results {path} have {len(boxes)} rows, but {rows} are needed, one a label"
        raise UserError(f"{problem}: run the tracker again, or fetch the file again")
    return boxes


def score_results(
    labels: dict[str, FloatArray],
    files: Files,
    conventions: Collection[Convention],
    counted: Callable[[str, FloatArray], FloatArray] = lambda _, boxes: boxes,
    left_out: dict[str, str] | None = None,
) -> dict[Convention, dict[str, Scores]]:
    """Scores by convention and sequence, in the order of the labels; sequences without a file are left out.

    Args:
        labels: ``(n, 4)`` by sequence.
        files: the tracker's result files.
        conventions: those to follow.
        counted: see `Benchmark.counted`.
        left_out: given one, sequences that cannot be scored are left out too, and the reasons are added by name.

    Raises:
        UserError: a result is as `read_result` says, or a sequence has no label that counts.
    """
    scores: dict[Convention, dict[str, Scores]] = {kind: {} for kind in conventions}
    for name, truth in labels.items():
        if name not in files:
            continue
        try:
            boxes = read_result(files[name], len(truth), functools.partial(counted, name))
            found = {kind: _scored(name, truth, boxes, kind) for kind in conventions}
        except UserError as error:
            if left_out is None:
                raise
            left_out[name] = str(error)
        else:
            for kind, by_name in scores.items():
                by_name[name] = found[kind]
    return scores


def _scored(name: str, truth: FloatArray, boxes: FloatArray, kind: Convention) -> Scores:
    try:
        return score_sequence(truth, boxes, kind)
    except UserError as error:
        raise UserError(f"sequence {name}: {error}") from None


def _trackers(folder: Path, name: str, names: dict[str, str]) -> dict[str, Files]:
    """Results that lie in a folder itself; only `.mat` files may name their tracker, the others' is the folder."""
    found: dict[str, Files] = {}
    # Sorted, a text follows the .mat of its name and takes its place: it needs no further library.
    for path in sorted(folder.iterdir()):
        tracker, stem = name, path.name if path.is_dir() else path.stem
        sequence = _lookup(stem, names)
        if path.is_dir():
            path = path / f"{path.name}_001.txt"
        elif path.suffix == ".mat" and sequence is None:
            # The longest name wins: car1_1_KCF is of car1_1, not of car1.
            for cut in reversed([sign.start() for sign in re.finditer("_", stem)]):
                if sequence is None:
                    sequence, tracker = _lookup(stem[:cut], names), stem[cut + 1 :]
        if sequence is not None and path.suffix in (".txt", ".mat") and path.is_file():
            found.setdefault(tracker, {})[sequence] = path
    return found


def _lookup(stem: str, names: dict[str, str]) -> str | None:
    return names.get(stem) or names.get(_key(stem))


def _key(name: str) -> str:
    # Jogging-1, Jogging.1 and jogging_1 are one sequence, but car1_1 and car11 are two.
    return re.sub(r"[^a-z0-9]+", "_", name.lower())


def _subfolders(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))


def _with_dataset(folder: Path, dataset: Collection[str]) -> list[Path]:
    """Where to look, the benchmark's own folders first: another benchmark's may have sequences of the same names."""
    keys = {_key(name) for name in dataset}
    return [*(path for path in _subfolders(folder) if _key(path.name) in keys), folder]


def _read_mat(path: Path) -> FloatArray:
    """The field ``res`` of the variable ``results``, a struct or a cell that holds one."""
    content = read_bytes(path, "results", "fetch the file again", 2**28)
    try:
        value = read_variable(content, "results")
        boxes = value.get("res") if isinstance(value, dict) else None
        if isinstance(value, dict) and value.get("type", "rect") != "rect":
            raise ValueError("its boxes are not of type 'rect'")
        if not isinstance(boxes, np.ndarray) or boxes.ndim != 2 or boxes.shape[1] != 4:
            raise ValueError(f"its field res has shape {getattr(boxes, 'shape', None)}")
    except ValueError as error:
        raise UserError(
            f"results {path} cannot be read ({brief(error)}): a variable results with a field res, "
            "one x,y,w,h per row, saved as -v7, is expected"
        ) from None
    return boxes.astype(np.float64)

"""Boxes that trackers left behind, in the layouts in which others publish them.

A folder of results holds one tracker's sequences, or one folder per tracker. A sequence is

* ``<sequence>.txt``: one box per line, separated by commas, tabs or blanks (pysot, the GOT-10k toolkit, this package);
* ``<sequence>/<sequence>_001.txt``: results on GOT-10k itself;
* ``<sequence>.mat`` or ``<sequence>_<tracker>.mat``: the toolkits of OTB, UAV123 and the correlation filters.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from psiamfcpp.datasets.boxes import read_boxes
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.metrics import Convention, Scores, score_sequence
from psiamfcpp.geometry import FloatArray

Files = dict[str, Path]
"""result files by sequence"""


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


def count_missing(tracker: str, files: Files, sequences: Collection[str], allow: bool) -> int:
    """How many sequences a tracker has no result of.

    Raises:
        UserError: it lacks one, and that is not allowed; names the first.
    """
    missing = [name for name in sequences if name not in files]
    if missing and not allow:
        raise UserError(
            f"tracker {tracker} lacks {len(missing)} of {len(sequences)} sequences, the first is {missing[0]}: "
            "add its result, or give --allow-missing"
        )
    return len(missing)


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
    try:
        return np.array([float(line.replace(",", " ").split()[0]) for line in path.read_text("utf-8-sig").splitlines()])
    except (OSError, ValueError, IndexError) as error:
        raise UserError(f"times {path} cannot be read ({error}): run the tracker again") from None


def read_result(path: Path, rows: int) -> FloatArray:
    """Boxes ``(rows, 4)`` of a result file; those that are NaN or have no area stay so.

    Raises:
        UserError: the file cannot be read, holds anything but four numbers a row, or has another number of rows.
    """
    boxes = _read_mat(path) if path.suffix == ".mat" else read_boxes(path)
    if len(boxes) != rows:
        problem = f"results {path} have {len(boxes)} rows, but {rows} are needed, one a label"
        raise UserError(f"{problem}: run the tracker again, or fetch the file again")
    return boxes


def score_results(
    labels: dict[str, FloatArray], files: Files, conventions: Collection[Convention]
) -> dict[Convention, dict[str, Scores]]:
    """Scores by convention and sequence, in the order of the labels; sequences without a file are left out.

    Args:
        labels: ``(n, 4)`` by sequence.
        files: the tracker's result files.
        conventions: those to follow.

    Raises:
        UserError: a result is as `read_result` says, or a sequence has no label that counts.
    """
    scores: dict[Convention, dict[str, Scores]] = {kind: {} for kind in conventions}
    for name, truth in labels.items():
        if name in files:
            boxes = read_result(files[name], len(truth))
            for kind, by_name in scores.items():
                try:
                    by_name[name] = score_sequence(truth, boxes, kind)
                except UserError as error:
                    raise UserError(f"sequence {name}: {error}") from None
    return scores


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
    try:
        from scipy.io import loadmat
    except ImportError:
        raise UserError(f"results {path} are a .mat file, which SciPy reads: pip install scipy") from None
    try:
        value: Any = loadmat(path, struct_as_record=False)["results"]
        while isinstance(value, np.ndarray):
            value = value.flat[0]
        if getattr(value, "type", np.array(["rect"])).tolist() != ["rect"]:
            raise ValueError("its boxes are not of type 'rect'")
        boxes = np.asarray(value.res, np.float64)
        if boxes.ndim != 2 or boxes.shape[1] != 4:
            raise ValueError(f"its field res has shape {boxes.shape}")
    # A file that is cut, or none of MATLAB's, makes SciPy fail in many ways.
    except Exception as error:
        problem = f"results {path} cannot be read ({type(error).__name__}: {error})"
        raise UserError(
            f"{problem}: a variable results with a field res, one x,y,w,h per row, saved as -v7, is expected"
        ) from None
    return boxes

"""Readers, one file a layout, each with ``read(root) -> list[Sequence]``.

`READERS` are for training: where a target cannot be seen there is no box. `BENCHMARKS` are for evaluation: their labels
stay as published, because conventions differ in what such rows count for.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from psiamfcpp.datasets import clips, coco, folder, got10k, imagenet_vid, lasot, stills, trackingnet
from psiamfcpp.datasets.benchmarks import BENCHMARKS, Benchmark, BenchmarkName
from psiamfcpp.datasets.sequence import LeftOut, Sequence
from psiamfcpp.errors import UserError
from psiamfcpp.files import reading

__all__ = ["BENCHMARKS", "READERS", "Benchmark", "BenchmarkName", "Sequence", "named", "read", "read_entry"]

READERS: dict[str, Callable[[Path, LeftOut], list[Sequence]]] = {
    "folder": folder.read,
    "clips": clips.read,
    "stills": stills.read,
    "got10k": got10k.read,
    "coco": coco.read,
    "lasot": lasot.read,
    "imagenet-vid": imagenet_vid.read,
    "trackingnet": trackingnet.read,
}


def read(kind: str, root: Path, left_out: LeftOut = None) -> list[Sequence]:
    """Read the dataset of a known layout.

    Args:
        kind: a key of `READERS`.
        root: folder of the dataset.
        left_out: given a list, what is not as the layout says is left out, and a line on each is appended.

    Raises:
        UserError: the layout is unknown, the root is missing, or the files are not as that layout says.
    """
    if kind not in READERS:
        raise UserError(f"unknown dataset layout {kind!r}: known are {', '.join(READERS)}")
    with reading():
        if not root.is_dir():
            raise UserError(f"dataset folder {root} does not exist: give the folder that holds the data")
        return READERS[kind](root, left_out)


def read_entry(entry: str, left_out: LeftOut = None) -> list[Sequence]:
    """Read a dataset given as ``LAYOUT:FOLDER``; ``left_out`` is that of `read`.

    Raises:
        UserError: there is no colon, or as of `read`.
    """
    kind, colon, folder = entry.partition(":")
    if not colon:
        raise UserError(f"data {entry!r} is not LAYOUT:FOLDER; layouts are {', '.join(READERS)}")
    return read(kind, Path(folder), left_out)


def named(entry: str) -> str:
    """A dataset given as ``LAYOUT:FOLDER`` as a model's provenance names it: without where the folder lies."""
    kind, _, folder = entry.partition(":")
    return f"{kind}:{Path(folder).name}"

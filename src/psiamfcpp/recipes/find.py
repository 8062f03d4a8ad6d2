"""Find benchmarks in a folder of benchmarks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from psiamfcpp.datasets import Benchmark
from psiamfcpp.errors import UserError


@dataclass(frozen=True)
class Found:
    """What of a benchmark is in a folder."""

    root: str
    sequences: int = 0
    labels: int = 0
    frames: int = 0
    """0 where the frames are missing, or cannot be read"""
    problem: str | None = None


def find_benchmark(benchmark: Benchmark, root: Path) -> Found | None:
    """Return what of a benchmark is in a folder of its name, or in the root itself; None if that is nothing.

    Args:
        benchmark: the benchmark.
        root: folder that holds the benchmarks' folders, or a benchmark's own.
    """
    folders = [root, *sorted(path for path in root.iterdir() if path.is_dir())]
    named = [path for path in folders if benchmark.owns(path if path.name else path.resolve())]
    # Several folders may bear its names, as one archive holds several benchmarks.
    place = next((path for path in named if benchmark.label_files(path)), named[0] if named else root)
    found = Found(str(place))
    try:
        # A plain folder of labels could be anybody's: its name must decide.
        if not named and not benchmark.label_files(place):
            return None
        labels = benchmark.read_labels(place)
        found = Found(str(place), len(labels), sum(map(len, labels.values())))
        return Found(found.root, found.sequences, found.labels, sum(map(len, benchmark.read(place))))
    except UserError as error:
        return Found(found.root, found.sequences, found.labels, 0, str(error))

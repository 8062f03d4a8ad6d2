"""The benchmarks by name: where to get each, how to read it, and how to read its labels where the frames are absent."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NoReturn

from psiamfcpp.datasets import dtb70, folder, got10k_val, otb100, uavdt, visdrone2018
from psiamfcpp.datasets.boxes import find_files, read_boxes
from psiamfcpp.datasets.sequence import LeftOut, Sequence
from psiamfcpp.datasets.uav123 import UAV20L, UAV123, UAV123_10FPS, Uav123
from psiamfcpp.errors import UserError
from psiamfcpp.files import reading
from psiamfcpp.geometry import FloatArray

BenchmarkName = Literal[
    "uav123-10fps", "uav123", "uav20l", "dtb70", "uavdt", "visdrone2018", "otb100", "got10k-val", "folder"
]


@dataclass(frozen=True)
class Benchmark:
    """One benchmark in its official layout."""

    name: str
    folders: tuple[str, ...]
    """usual names of its folder"""
    size: int | None
    """official number of sequences"""
    source: str
    """where to get it"""
    layout: str
    """the expected layout, in one line"""
    labels: str
    """where in its folder the labels are: named when there are none"""
    reader: Callable[[Path, LeftOut], list[Sequence]]
    """sequences of a root; an empty list where there is none"""
    label_files: Callable[[Path], dict[str, Path]]
    """label files of a root in the official layout, by sequence; empty where there is none"""
    counted: Callable[[str, FloatArray], FloatArray] = lambda _, boxes: boxes
    """rows that count of a sequence's labels, or of a result with a row for each frame"""

    def read(self, root: Path, left_out: dict[str, str] | None = None) -> list[Sequence]:
        """Every sequence with its frames.

        Args:
            root: its folder.
            left_out: given one, sequences that cannot be read are left out, and the reasons are added by name.

        Raises:
            UserError: the root is missing, or its files are not as the layout says.
        """
        reasons: list[str] = []
        with reading():
            self._check(root)
            found = self.reader(root, None if left_out is None else reasons)
        if left_out is not None and reasons:
            names = {sequence.name for sequence in found}
            # readers go through the label files in order, and give one line on each that they leave out
            left_out.update(zip((n for n in self.label_files(root) if n not in names), reasons, strict=True))
        if not found and reasons:
            raise UserError(f"{root} holds no sequence of {self.name} that can be read, the first: {reasons[0]}")
        return found or self._refuse(root)

    def read_labels(self, root: Path, left_out: dict[str, str] | None = None) -> dict[str, FloatArray]:
        """Labels ``(n, 4)`` of every sequence, without its frames, the rows as published.

        Args:
            root: the official layout, or a plain folder of ``<sequence>.txt``.
            left_out: as of `read`.

        Raises:
            UserError: there is none, or one cannot be read or is empty.
        """
        with reading():
            self._check(root)
            files = self.label_files(root) or {path.stem: path for path in find_files(root, "*.txt")}
        labels = {}
        for name, path in files.items():
            try:
                labels[name] = self._labels(name, path)
            except UserError as error:
                if left_out is None:
                    raise
                left_out[name] = str(error)
        if files and not labels and left_out:
            raise UserError(next(iter(left_out.values())))
        return labels or self._refuse(root, "a plain folder of <sequence>.txt, or ")

    def _labels(self, name: str, path: Path) -> FloatArray:
        boxes = self.counted(name, read_boxes(path))
        if not len(boxes):
            raise UserError(f"labels {path} are empty: fetch them again")
        return boxes

    def owns(self, path: Path) -> bool:
        """Whether a folder bears the name of this benchmark, in whatever spelling."""
        return _letters(path.name) in {_letters(name) for name in (self.name, *self.folders)}

    def _check(self, root: Path) -> None:
        if not root.is_dir():
            raise UserError(f"dataset folder {root} does not exist: give the folder that holds the sequences")

    def _refuse(self, root: Path, other: str = "") -> NoReturn:
        raise UserError(
            f"{root} holds no sequence of {self.name}: {root / self.labels} is missing; "
            f"expected layout: {other}{self.layout}"
        )


def _letters(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _uav(part: Uav123, folders: tuple[str, ...], size: int) -> Benchmark:
    source = "https://cemse.kaust.edu.sa/ivul/uav123"
    labels = f"anno/{part.labels}/<sequence>.txt"
    return Benchmark(part.name, folders, size, source, part.layout, labels, part.read, part.label_files)


BENCHMARKS = {
    benchmark.name: benchmark
    for benchmark in (
        # Its download may unpack into a folder UAV123.
        _uav(UAV123_10FPS, ("UAV123_10fps", "UAV123"), 123),
        _uav(UAV123, ("UAV123",), 123),
        # UAV20L comes in the download of UAV123, and shares its frames.
        _uav(UAV20L, ("UAV20L", "UAV123"), 20),
        Benchmark(
            "dtb70",
            ("DTB70", "DTB"),
            70,
            "https://github.com/flyers/drone-tracking",
            dtb70.LAYOUT,
            "<sequence>/groundtruth_rect.txt",
            dtb70.read,
            dtb70.label_files,
        ),
        Benchmark(
            "uavdt",
            ("UAVDT", "UAV-benchmark-S", "UAV-benchmark-SOT_v1.0"),
            50,
            "https://sites.google.com/view/grli-uavdt",
            uavdt.LAYOUT,
            "anno/<sequence>_gt.txt",
            uavdt.read,
            uavdt.label_files,
        ),
        Benchmark(
            "visdrone2018",
            ("VisDrone2018-SOT-test-dev", "VisDrone2018-SOT", "VisDrone2018"),
            35,
            "https://github.com/VisDrone/VisDrone-Dataset",
            visdrone2018.LAYOUT,
            "annotations/<sequence>.txt",
            visdrone2018.read,
            visdrone2018.label_files,
        ),
        Benchmark(
            "otb100",
            ("OTB100", "OTB", "OTB2015", "tracker_benchmark"),
            100,
            "http://cvlab.hanyang.ac.kr/tracker_benchmark",
            otb100.LAYOUT,
            "<sequence>/groundtruth_rect.txt",
            otb100.read,
            otb100.label_files,
            otb100.counted,
        ),
        Benchmark(
            "got10k-val",
            ("GOT-10k",),
            180,
            "http://got-10k.aitestunion.com",
            got10k_val.LAYOUT,
            "val/list.txt",
            got10k_val.read,
            got10k_val.label_files,
        ),
        Benchmark(
            "folder",
            (),
            None,
            "your own clips",
            folder.LAYOUT,
            ".../groundtruth_rect.txt",
            folder.read,
            folder.label_files,
        ),
    )
}

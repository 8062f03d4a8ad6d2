"""The command line, run in this process, and what the commands are given."""

from __future__ import annotations

import importlib.util
import math
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from psiamfcpp.cli import main
from psiamfcpp.spec import ModelSpec
from psiamfcpp.video.source import open_source
from psiamfcpp.video.writer import VideoWriter

Image = NDArray[np.uint8]
Box = tuple[float, float, float, float]
FRAMES = 10
# In every clip and folder here a blob moves like this.
PATH: list[Box] = [(100.0 + 3 * t, 80.0 + t, 40.0, 30.0) for t in range(FRAMES)]


@dataclass
class Ended:
    """What a command left behind."""

    code: int
    out: str
    err: str

    def refused(self) -> str:
        """The error, if the command ended as every refusal must: code 2, one line, no result."""
        assert (self.code, self.out) == (2, "")
        return self.complaint()

    def complaint(self) -> str:
        """The one line on standard error."""
        (line,) = self.err.splitlines()
        assert line.startswith("psiamfcpp: ")
        return line.removeprefix("psiamfcpp: ")


Run = Callable[..., Ended]


@pytest.fixture(autouse=True)
def no_progress_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Off a terminal, progress is a line every so many seconds: whether one comes must not depend on the machine."""
    monkeypatch.setattr("psiamfcpp.cli.output.LINE_SECONDS", math.inf)


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Run:
    """Runs a command; what libraries write past Python is seen too."""

    def call(*args: object) -> Ended:
        capfd.readouterr()
        ended = Ended(main([str(arg) for arg in args]), *capfd.readouterr())
        missing = re.search(r"^psiamfcpp: this needs (\w+): pip install 'psiamfcpp\[", ended.err)
        # A library that a test hides stands in sys.modules as None: that message is what the test is about.
        if missing and missing[1] not in sys.modules and importlib.util.find_spec(missing[1]) is None:
            pytest.skip(f"{missing[1]} is not installed")
        return ended

    return call


@pytest.fixture(scope="session")
def moving_blob(tmp_path_factory: pytest.TempPathFactory, blob_frame: Callable[..., Image]) -> Path:
    """The moving blob as a video and as a folder of images, made once."""
    root = tmp_path_factory.mktemp("blob")
    (root / "pictures").mkdir()
    with VideoWriter(root / "clip.mp4", 25, (320, 240)) as writer:
        for number, box in enumerate(PATH):
            frame = blob_frame(box)
            writer.write(frame)
            cv2.imwrite(str(root / "pictures" / f"{number}.png"), frame)
    return root


@pytest.fixture
def clip(tmp_path: Path, moving_blob: Path) -> Path:
    """A video of the moving blob."""
    return Path(shutil.copy(moving_blob / "clip.mp4", tmp_path))


@pytest.fixture
def pictures(tmp_path: Path, moving_blob: Path) -> Path:
    """A folder of images of the moving blob."""
    return Path(shutil.copytree(moving_blob / "pictures", tmp_path / "pictures"))


@pytest.fixture(scope="session")
def full_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of the unpruned network with random weights."""
    import torch

    from psiamfcpp.models import SiamFCpp, save

    path = tmp_path_factory.mktemp("full") / "full.safetensors"
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        save(path, SiamFCpp(ModelSpec()))
    return path


def count_frames(video: Path) -> int:
    """Frames of a video that was written to its end."""
    with open_source(video) as source:
        return sum(1 for _ in source)


def read_boxes(path: Path) -> NDArray[np.float64]:
    """Boxes ``(n, 4)`` of a boxes file, every line of it whole."""
    text = path.read_text()
    assert text.endswith("\n")
    return np.array([[float(v) for v in line.split(",")] for line in text.splitlines()]).reshape(-1, 4)

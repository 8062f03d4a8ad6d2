"""Miniature training data: grey pictures in which each target is a rectangle of a colour of its own."""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from psiamfcpp.datasets import Sequence

Image = NDArray[np.uint8]
Box = tuple[float, float, float, float]
Colour = tuple[int, int, int]


def colour(number: int, of: int = 12) -> Colour:
    """A saturated colour, BGR; far from grey and from the others."""
    r, g, b = colorsys.hsv_to_rgb(number / of, 1.0, 1.0)
    return (round(b * 255), round(g * 255), round(r * 255))


def paint(path: Path, targets: list[tuple[Box, Colour]], size: tuple[int, int] = (200, 160), seed: int = 0) -> Path:
    """A picture ``(width, height)`` of grey patches with whole-pixel boxes painted in."""
    coarse = np.random.default_rng(seed).integers(60, 140, (8, 10), dtype=np.uint8)
    grey = cv2.resize(coarse, size, interpolation=cv2.INTER_NEAREST)
    image = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    for (x, y, w, h), shade in targets:
        image[int(y) : int(y + h), int(x) : int(x + w)] = shade
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image)
    return path


def coloured(image: Image, shade: Colour) -> NDArray[np.bool_]:
    """Where an image shows a colour, edges apart, where it mixes with its surroundings."""
    return np.abs(image.astype(int) - np.array(shade)).max(axis=-1) < 40


@pytest.fixture(scope="session")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> list[Sequence]:
    """Four clips of six frames and six photographs with one target each, colour ``i`` for sequence ``i``."""
    root = tmp_path_factory.mktemp("scenes")
    sequences = []
    for i in range(4):
        boxes = [(40.0 + 10 * i + 4 * k, 50.0 + 3 * k, 24.0 + 2 * i, 30.0 - 2 * i) for k in range(6)]
        folder = root / "clips" / f"clip{i}" / "img"
        frames = [paint(folder / f"{k:03}.png", [(box, colour(i))], seed=i) for k, box in enumerate(boxes)]
        (folder.parent / "groundtruth_rect.txt").write_text("".join(",".join(map(str, b)) + "\n" for b in boxes))
        sequences.append(Sequence(f"clip{i}", frames, np.array(boxes), "clip"))
    for i in range(4, 10):
        box = (30.0 + 12 * i, 90.0 - 5 * i, 20.0 + i, 34.0 - i)
        path = paint(root / "photos" / f"{i}.png", [(box, colour(i))], seed=i)
        sequences.append(Sequence(f"{i}.png#2", [path], np.array([box]), "photos"))
    return sequences


@pytest.fixture(scope="session")
def clip_folder(scenes: list[Sequence]) -> Path:
    """The clips of `scenes` in the layout `folder`."""
    return scenes[0].frames[0].parents[2]


@pytest.fixture
def draw(tmp_path: Path) -> Callable[..., Sequence]:
    """Makes a sequence of painted frames: one list of ``(box, colour)`` a frame, the first being its target."""
    numbers: Iterator[int] = iter(range(10**6))

    def make(*frames: list[tuple[Box, Colour]], source: str = "", size: tuple[int, int] = (200, 160)) -> Sequence:
        name = f"sequence{next(numbers)}"
        paths = [paint(tmp_path / name / f"{k}.png", targets, size) for k, targets in enumerate(frames)]
        return Sequence(name, paths, np.array([targets[0][0] for targets in frames]), source)

    return make

"""The script on clips of a moving square, with trackers that know where it is, or stay where they began."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from psiamfcpp.errors import UserError

TRACKERS = """
import numpy as np


class Stays:
    def init(self, image, box):
        self.box = box

    def update(self, image):
        return self.box


class Sees(Stays):
    def update(self, image):
        rows, columns = np.nonzero(image[..., 0] > 150)
        return columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1
"""


@pytest.fixture
def roots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Two folders with a clip each: the square of one leaves its first place, that of the other stands still."""
    (tmp_path / "shapes.py").write_text(TRACKERS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("shapes", None)
    for name, pace in (("moving", 15), ("standing", 0)):
        folder = tmp_path / name / name
        (folder / "img").mkdir(parents=True)
        boxes = [(10 + pace * k, 20, 20, 20) for k in range(12)]
        for k, (x, y, w, h) in enumerate(boxes):
            image = np.zeros((60, 220, 3), np.uint8)
            image[y : y + h, x : x + w] = 200
            cv2.imwrite(str(folder / "img" / f"{k:03}.png"), image)
        (folder / "groundtruth_rect.txt").write_text("".join(",".join(map(str, box)) + "\n" for box in boxes))
    return tmp_path / "moving", tmp_path / "standing"


def figures(text: str, name: str) -> list[float]:
    line = next(line for line in text.splitlines() if line.startswith(name))
    return [float(number) for number in re.findall(r"-?\d\.\d{3}", line)]


def test_one_model_over_two_folders(script: ModuleType, roots, capsys: pytest.CaptureFixture[str]):
    script.main(("shapes:Stays",), roots)
    text = capsys.readouterr().out
    # Two of twelve frames lie within 20 pixels of the first box; from half on, two of six.
    assert figures(text, "moving")[0] == pytest.approx(2 / 12, abs=1e-3)
    assert figures(text, "moving")[2] == pytest.approx((3 * 2 / 12 + 2 * 2 / 9 + 2 * 2 / 6) / 7, abs=2e-3)
    assert figures(text, "standing")[0] == 1
    precision, low, high = figures(text, "mean, single pass")[:3]
    assert precision == pytest.approx((2 / 12 + 1) / 2, abs=1e-3)
    # Of two sequences, a quarter of the draws holds one alone.
    assert (low, high) == pytest.approx((2 / 12, 1), abs=1e-3)


def test_two_models_are_compared_sequence_by_sequence(script: ModuleType, roots, capsys: pytest.CaptureFixture[str]):
    script.main(("shapes:Stays", "shapes:Sees"), roots)
    text = capsys.readouterr().out
    assert figures(text, "second - first, single pass")[:3] == pytest.approx([5 / 12, 0, 10 / 12], abs=1e-3)


def test_a_model_against_itself_differs_nowhere(script: ModuleType, roots, capsys: pytest.CaptureFixture[str]):
    script.main(("shapes:Stays", "shapes:Stays"), roots)
    text = capsys.readouterr().out
    for kind in ("single pass", "seven starts"):
        assert figures(text, f"second - first, {kind}") == [0] * 6


@pytest.mark.parametrize("models", [(), ("a", "b", "c")])
def test_one_or_two_models(script: ModuleType, roots, models: tuple[str, ...]):
    with pytest.raises(UserError, match="one, or two to compare"):
        script.main(models, roots)


def test_the_interval_of_a_known_mean(script: ModuleType):
    draws = np.random.default_rng(1).normal(0.5, 0.1, 400)
    low, high = script.interval(draws)
    assert (high - low) / 2 == pytest.approx(1.96 * 0.1 / 20, rel=0.1)
    assert low < draws.mean() < high
    assert script.interval(np.full(7, 0.25)) == (0.25, 0.25)

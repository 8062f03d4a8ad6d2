"""The script on clips of a moving square, with a narrow network."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from psiamfcpp.errors import UserError


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two clips of fifteen frames."""
    for name, pace in (("moving", 3), ("standing", 0)):
        folder = tmp_path / "clips" / name
        (folder / "img").mkdir(parents=True)
        boxes = [(30 + pace * k, 20, 20, 20) for k in range(15)]
        for k, (x, y, w, h) in enumerate(boxes):
            image = np.full((80, 160, 3), 90, np.uint8)
            image[y : y + h, x : x + w] = 200
            cv2.imwrite(str(folder / "img" / f"{k:03}.png"), image)
        (folder / "groundtruth_rect.txt").write_text("".join(",".join(map(str, box)) + "\n" for box in boxes))
    return tmp_path / "clips"


@pytest.mark.slow
def test_each_side_is_compared_with_the_first_at_each_stride(
    script: ModuleType, root: Path, tiny_model: Path, capsys: pytest.CaptureFixture[str]
):
    script.main(str(tiny_model), root, (239, 191, 239), (1, 3))
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(": ")[0] for line in lines] == [
        f"stride {stride}, {size} pixels, 2 clips" for stride in (1, 3) for size in (239, 191, 239)
    ]
    # The first stands alone; the same side again differs nowhere.
    assert "[" not in lines[0] and lines[2].count("(+0.000 [+0.000, +0.000])") == 2
    means = [float(re.search(r"precision (\d\.\d{3})", line)[1]) for line in lines[:2]]
    change = float(re.search(r"\(([+-]\d\.\d{3})", lines[1])[1])
    assert change == pytest.approx(means[1] - means[0], abs=1.1e-3)


@pytest.mark.parametrize(
    ("strides", "reason"), [((1, 0), "stride 0 is none"), ((), "stride 0 is none"), ((4,), "no clip .* at stride 4")]
)
def test_strides_that_leave_nothing(script: ModuleType, root: Path, tiny_model: Path, strides, reason: str):
    with pytest.raises(UserError, match=reason):
        script.main(str(tiny_model), root, (191,), strides)


def test_no_side(script: ModuleType, root: Path, tiny_model: Path):
    with pytest.raises(UserError, match="no side is given"):
        script.main(str(tiny_model), root, ())

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.training.curve import draw_curve

ROW = {"step": 50, "cls": 1.0, "centerness": 0.6, "iou": 0.9, "total": 4.3, "lr": 1e-3, "pairs_per_s": 30.0}
CHECK = {"within8": 0.5, "within16": 0.6, "overlap": 0.4, "score": 0.3, "separation": 0.7}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    rows = [ROW, {**ROW, "step": 100, "cls": 0.5, "validation": CHECK}, {**ROW, "step": 150, "validation": CHECK}]
    path = tmp_path / "log.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


@pytest.mark.slow
def test_a_picture_comes_out(log: Path):
    picture = log.with_name("curve.png")
    draw_curve(log, picture)
    image = cv2.imread(str(picture))
    assert image is not None
    assert image.shape[1] > 800
    assert image.std() > 5, "something is drawn"
    assert sorted(p.name for p in log.parent.iterdir()) == ["curve.png", "log.jsonl"]


@pytest.mark.slow
def test_more_rows_give_another_picture(log: Path):
    one, two = log.with_name("one.png"), log.with_name("two.png")
    draw_curve(log, one)
    with log.open("a") as file:
        file.write(json.dumps({**ROW, "step": 200, "iou": 5.0}) + "\n")
    draw_curve(log, two)
    assert one.read_bytes() != two.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("text", ["", json.dumps(ROW) + "\n"], ids=["empty", "one row"])
def test_short_logs(tmp_path: Path, text: str):
    (tmp_path / "log.jsonl").write_text(text)
    draw_curve(tmp_path / "log.jsonl", tmp_path / "curve.png")
    assert cv2.imread(str(tmp_path / "curve.png")) is not None


@pytest.mark.slow
def test_separation_may_be_undefined(tmp_path: Path):
    row = {**ROW, "validation": {**CHECK, "separation": None}}
    (tmp_path / "log.jsonl").write_text(json.dumps(row) + "\n")
    draw_curve(tmp_path / "log.jsonl", tmp_path / "curve.png")
    assert (tmp_path / "curve.png").exists()


@pytest.mark.parametrize(
    "data",
    [
        b'{"step": 50, "cls"',
        b"junk\n",
        b"5\n",
        b'{"step": 50}\n',
        b"\xff\xfe\n",
        json.dumps({**ROW, "validation": {"within8": 1}}).encode(),
    ],
)
def test_damaged_logs_are_named(log: Path, data: bytes):
    log.write_bytes(log.read_bytes() + data)
    with pytest.raises(UserError, match=r"training log .*log\.jsonl"):
        draw_curve(log, log.with_name("curve.png"))
    assert not log.with_name("curve.png").exists()


def test_missing_log(tmp_path: Path):
    with pytest.raises(UserError, match=r"gone\.jsonl does not exist"):
        draw_curve(tmp_path / "gone.jsonl", tmp_path / "curve.png")

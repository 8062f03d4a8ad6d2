"""LightFC's procedure: crops, the chosen cell, the box in the frame; and that trackers and pools follow with it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiamfcpp.models.arch import architecture
from psiamfcpp.spec import Calibration, ModelSpec
from psiamfcpp.trackers.lightfc import PROCEDURE, clip, crop, estimate, window
from psiamfcpp.trackers.pool import TargetPool
from psiamfcpp.trackers.siamfcpp import Tracker
from psiamfcpp.trackers.siamfcpp.procedure import Estimate, Target

SPEC = ModelSpec(dict(architecture("lightfc").groups), 128, 256, calibration=None, architecture="lightfc")


def test_the_window_has_no_zeros_and_its_middle_lies_between_cells() -> None:
    found = window(16)
    line = [0.5 * (1 - np.cos(2 * np.pi * i / 17)) for i in range(1, 17)]
    np.testing.assert_allclose(found, np.outer(line, line))
    assert found.min() > 0 and found[7, 7] == pytest.approx(found[8, 8])


@pytest.mark.parametrize(("size", "factor"), [(128, 2), (256, 4)])
def test_a_crop_is_a_square_of_whole_pixels(size: int, factor: int) -> None:
    rng = np.random.default_rng(0)
    frame = rng.integers(0, 256, (600, 600, 3), np.uint8)
    # sqrt(wh) is a quarter of the search crop, so nothing is resized
    target = Target(299.9, 310.2, 128, 32)
    found = crop(frame, target, size, 128, (0, 0, 0))
    assert found.shape == (64 * factor,) * 2 + (3,)
    left, top = round(300.4 - 32 * factor), round(310.7 - 32 * factor)
    np.testing.assert_array_equal(found, frame[top : top + 64 * factor, left : left + 64 * factor])


def test_outside_the_frame_is_black() -> None:
    found = crop(np.full((100, 100, 3), 200, np.uint8), Target(0, 50, 16, 16), 256, 128, PROCEDURE.fill(np.zeros(0)))
    assert not found[:, :120].any() and (found[:, 136:] == 200).all()


def maps(cell: tuple[int, int], box: tuple[float, float, float, float]) -> tuple[Any, Any]:
    scores, boxes = np.full((16, 16), 0.1), np.tile(np.float64([0, 0, 9, 9]), (16, 16, 1))
    scores[cell], boxes[cell] = 0.9, box
    return scores, boxes


def test_a_box_is_mapped_to_the_frame() -> None:
    # a crop of 128 pixels of the frame, shown at twice the size
    previous = Target(100.0, 50.0, 32.0, 32.0)
    found = estimate(*maps((8, 9), (128, 108, 167, 147)), previous, SPEC, window(16))
    assert (found.cell, found.score, found.penalty) == ((8, 9), 0.9, 1.0)
    assert found.target == Target(100 + (147.5 - 127.5) / 2, 50.0, 20.0, 20.0)


def test_what_is_far_needs_a_higher_score() -> None:
    scores, boxes = maps((8, 8), (0, 0, 9, 9))
    scores[0, 0] = 1.0
    assert estimate(scores, boxes, Target(50, 50, 20, 20), SPEC, window(16)).cell == (8, 8)
    scores[8, 8] = 1e-4
    assert estimate(scores, boxes, Target(50, 50, 20, 20), SPEC, window(16)).cell != (8, 8)


def test_a_box_is_cut_at_the_frame() -> None:
    # pixels -5 to 14 and 90 to 109 of a frame of 100x100
    found = Estimate(Target(4.5, 99.5, 20, 20), 0.9, 1.0, (0, 0))
    assert clip(Target(10, 90, 20, 20), found, 1.0, (100, 100, 3), 1.0) == Target(7.0, 94.5, 15, 10)
    inside = Estimate(Target(40.0, 60.5, 9, 8), 0.9, 1.0, (0, 0))
    assert clip(Target(10, 90, 20, 20), inside, 1.0, (100, 100, 3), 1.0) == inside.target


@given(*[st.floats(-1e4, 1e4)] * 2, *[st.floats(1e-3, 1e4)] * 2)
def test_a_box_stays_inside_and_holds_a_pixel(cx: float, cy: float, w: float, h: float) -> None:
    found = clip(Target(5, 5, 5, 5), Estimate(Target(cx, cy, w, h), 1, 1, (0, 0)), 1.0, (40, 60, 3), 1.0)
    for centre, side, length in ((found.cx, found.w, 60), (found.cy, found.h, 40)):
        assert 1 - 1e-9 <= side <= length
        assert centre + 0.5 - side / 2 >= -1e-9 and centre + 0.5 + side / 2 <= length + 1e-9


class BlobLightFC:
    """An engine of LightFC's kind that finds a bright rectangle in black ground."""

    name, device, precision = "blob", "cpu", "fp32"

    def __init__(self, calibration: Calibration | None = None):
        self.spec = ModelSpec(SPEC.widths, 128, 256, calibration=calibration, architecture="lightfc")

    def template(self, crop: Any) -> Any:
        assert crop.shape == (128, 128, 3)
        return crop.copy()

    def search(self, crop: Any, kernels: Any) -> tuple[Any, Any]:
        rows, columns = (np.flatnonzero((crop[..., 0] > 128).any(axis=axis)) for axis in (1, 0))
        scores, boxes = np.full((16, 16), 0.01, np.float32), np.zeros((16, 16, 4), np.float32)
        if len(rows):
            box = columns[0], rows[0], columns[-1], rows[-1]
            scores[(box[1] + box[3]) // 32, (box[0] + box[2]) // 32] = 0.9
            boxes[:] = box
        return scores, boxes

    def search_many(self, crops: Any, kernels: list[Any]) -> tuple[Any, Any]:
        scores, boxes = zip(*(self.search(crop, None) for crop in crops), strict=True)
        return np.stack(scores), np.stack(boxes)


@pytest.mark.parametrize(
    ("calibration", "plain", "state"),
    [(None, False, None), (None, True, None), (Calibration(), True, "tracking"), (Calibration(), False, "tracking")],
)
def test_a_tracker_follows_by_the_procedure_of_its_model(
    blob_frame: Callable[..., Any], calibration: Calibration | None, plain: bool, state: str | None
) -> None:
    tracker = Tracker(engine=BlobLightFC(calibration), plain=plain)
    boxes = [(100 + 4 * i, 80 + 2 * i, 40 + i, 30) for i in range(12)]
    assert tracker.init(blob_frame(boxes[0]), boxes[0]).state == state
    for box in boxes[1:]:
        track = tracker.update(blob_frame(box))
        # the size is taken as found, without smoothing
        np.testing.assert_allclose(track.box, box, atol=1.0)
        assert track.state == state and track.score == pytest.approx(0.9, abs=1e-6)


def test_a_pool_follows_as_trackers_do(blob_frame: Callable[..., Any]) -> None:
    pool, alone = TargetPool(engine=BlobLightFC()), Tracker(engine=BlobLightFC())
    first, second = (60, 60, 40, 30), (200, 140, 30, 30)
    pool.add(blob_frame(first), first)
    pool.add(blob_frame(second), second)
    alone.init(blob_frame(first), first)
    for i in range(1, 5):
        frame = blob_frame((60 + 5 * i, 60, 40, 30))
        assert pool.update(frame)[1] == alone.update(frame)


@pytest.mark.slow
def test_a_real_target_is_followed(shared_data: Path) -> None:
    pytest.importorskip("onnx")
    pytest.importorskip("torch")
    from psiamfcpp.datasets import read
    from psiamfcpp.geometry import overlap
    from psiamfcpp.models.lightfc_import import import_lightfc
    from psiamfcpp.runtime.torch_engine import TorchEngine

    files = tuple(shared_data.parent / "weights" / "peers" / f"lightfc_{name}.onnx" for name in ("template", "track"))
    if not all(path.is_file() for path in files):
        pytest.skip(f"no graphs of LightFC in {files[0].parent}")
    (sequence,) = (s for s in read("folder", shared_data / "uav" / "DTB70") if s.name == "MountainBike6")
    tracker = Tracker(engine=TorchEngine(import_lightfc(*files), threads=1))
    tracker.init(sequence.frame(0), sequence.boxes[0])
    boxes = [tracker.update(sequence.frame(i)).box for i in range(1, 31)]
    assert overlap(boxes, sequence.boxes[1:31]).mean() > 0.7

"""A Tracker on an engine of the user's, and states that share one engine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from psiamfcpp import TargetPool, Tracker, TrackerOptions, UserError
from psiamfcpp.geometry import Image
from psiamfcpp.trackers.siamfcpp.tracker import update_many

Draw = Callable[..., Image]


def test_an_engine_object_takes_the_place_of_a_model(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = Tracker(engine=blob_engine, plain=True)
    assert (tracker.name, tracker.options) == ("BlobEngine", TrackerOptions(plain=True))
    tracker.init(blob_frame((100, 80, 40, 30)), (100, 80, 40, 30))
    assert tracker.update(blob_frame((105, 82, 40, 30))).box == pytest.approx((105, 82, 40, 30), abs=1.5)
    pool = TargetPool(engine=blob_engine)
    pool.add(blob_frame((100, 80, 40, 30)), (100, 80, 40, 30))
    assert pool.update(blob_frame((105, 82, 40, 30)))[1].box == pytest.approx((105, 82, 40, 30), abs=1.5)


def test_a_tracker_without_a_target_says_what_to_do(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = Tracker(engine=blob_engine)
    for call in (lambda: tracker.update(blob_frame(None)), lambda: tracker.look(blob_frame(None), None)):
        with pytest.raises(UserError, match=r"before init\(\)"):
            call()
    tracker.init(blob_frame((100, 80, 40, 30)), (100, 80, 40, 30))
    tracker.close()
    tracker.close()
    with pytest.raises(UserError, match=r"before init\(\)"):
        tracker.update(blob_frame(None))


def test_looking_changes_nothing(blob_engine: Any, blob_frame: Draw) -> None:
    truth = (108, 84, 40, 30)
    seen, unseen = (Tracker(engine=blob_engine) for _ in range(2))
    for tracker in (seen, unseen):
        tracker.init(blob_frame((100, 80, 40, 30)), (100, 80, 40, 30))
    blob_engine.templates[:] = blob_engine.templates[-1:]  # both have equal kernels
    seen.following._kernels = unseen.following._kernels = 1
    found, _ = seen.look(blob_frame(truth), seen.following._target)
    assert (found.target.cx, found.target.cy) == pytest.approx((127.5, 98.5), abs=1)
    assert seen.update(blob_frame(truth)) == unseen.update(blob_frame(truth))


def test_many_states_cost_one_call_of_the_engine(blob_engine: Any, blob_frame: Draw) -> None:
    frame = np.maximum(blob_frame((30, 30, 40, 30)), blob_frame((30, 30, 40, 30)))
    tracker = Tracker(engine=blob_engine)
    targets = [tracker.follow(frame, (30, 30, 40, 30)) for _ in range(3)]
    tracks = update_many(blob_engine, targets, frame, np.empty((3, 303, 303, 3), np.uint8))
    assert blob_engine.batches == [[1, 2, 3]]
    assert [track.box for track in tracks] == [pytest.approx((30, 30, 40, 30), abs=1)] * 3


def test_unknown_options_are_refused(blob_engine: Any) -> None:
    with pytest.raises(TypeError, match="depth"):
        Tracker(engine=blob_engine, depth=3)


@pytest.mark.parametrize("level", [0, 90, 255])
def test_blank_frames_are_no_evidence(blob_engine: Any, blob_frame: Draw, level: int) -> None:
    tracker = Tracker(engine=blob_engine)
    tracker.init(blob_frame((100, 80, 40, 30)), (100, 80, 40, 30))
    for t in range(1, 6):
        before = tracker.update(blob_frame((100 + 2 * t, 80, 40, 30)))
    noise = np.random.default_rng(0).integers(-1, 2, (240, 320, 3))
    blank = np.clip(level + noise, 0, 255).astype(np.uint8)
    states = [tracker.update(blank).state for _ in range(60)]
    # said at once, and the box stays where the target was seen last
    assert states[0] != "tracking" and states[-1] == "lost"
    assert tracker.update(blank).box == before.box
    again = tracker.update(blob_frame((110, 80, 40, 30)))
    assert (again.state, again.box) == ("tracking", pytest.approx((110, 80, 40, 30), abs=1.5))


def test_the_published_procedure_takes_blank_frames_as_any_other(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = Tracker(engine=blob_engine, plain=True)
    tracker.init(blob_frame((100, 80, 40, 30)), (100, 80, 40, 30))
    tracker.update(np.zeros((240, 320, 3), np.uint8))
    assert len(blob_engine.searches) == 1
    assert tracker.update(np.zeros((240, 320, 3), np.uint8)).state == "tracking"

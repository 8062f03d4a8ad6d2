"""The tracker, on an engine that sees a blob (tests/conftest.py) and so is never wrong about where it is."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from psiamfcpp import Track, Tracker, UserError
from psiamfcpp.geometry import Box, centre_error, overlap
from psiamfcpp.trackers.siamfcpp.confidence import LOST_AFTER
from psiamfcpp.trackers.siamfcpp.following import LOOK_EVERY, SEARCH_AFTER

Draw = Callable[..., Any]
START: Box = (100, 80, 40, 30)


@pytest.fixture
def blob_frame(blob_frame: Draw) -> Draw:
    """The frames of a video that runs: each differs a little from the one before."""
    count = itertools.count()

    def draw(*args: Any, **options: Any) -> Any:
        return np.minimum(blob_frame(*args, **options), 254) + np.uint8(next(count) % 2)

    return draw


def begun(draw: Draw, box: Box = START, **options: Any) -> Tracker:
    tracker = Tracker(**options)
    assert tracker.init(draw(box), box) == Track(box, 1.0, "tracking")
    return tracker


@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("velocity", [(0, 0), (3, 0), (-2.5, 1.5), (4, 4), (12, -5)])
def test_a_moving_blob_is_followed(blob_engine: Any, blob_frame: Draw, velocity: Box, plain: bool) -> None:
    tracker = begun(blob_frame, plain=plain)
    for t in range(1, 13):
        x, y = (p + v * t for p, v in zip(START, velocity, strict=False))
        track = tracker.update(blob_frame((x, y, 40, 30)))
        assert track.state == "tracking"
        assert centre_error(track.box, (x, y, 40, 30)) < 1
        assert overlap(track.box, (x, y, 40, 30)) > 0.93


@pytest.mark.parametrize("growth", [1.03, 0.97])
def test_a_change_of_size_is_followed(blob_engine: Any, blob_frame: Draw, growth: float) -> None:
    tracker = begun(blob_frame)
    for t in range(1, 25):
        w, h = 40 * growth**t, 30 * growth**t
        truth = (120 - w / 2, 95 - h / 2, w, h)
        track = tracker.update(blob_frame(truth))
    assert centre_error(track.box, truth) < 1
    # half of the difference is made up for in each frame, so the lag is about one frame's growth
    assert track.box[2:] == pytest.approx((w, h), rel=0.06)


def test_a_small_target_is_followed_down_to_ten_pixels_only(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = begun(blob_frame, (150, 110, 20, 16))
    for t in range(25):
        side = 20 * 0.93**t
        track = tracker.update(blob_frame((160 - side / 2, 118 - side * 0.4, side, side * 0.8)))
    assert side < 4
    assert track.box[2:] == (10, 10)


def test_a_target_that_begins_smaller_may_stay_so(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = begun(blob_frame, (150, 110, 8, 6))
    for _ in range(5):
        track = tracker.update(blob_frame((150, 110, 8, 6)))
    assert track.box == pytest.approx((150, 110, 8, 6), abs=1)


def test_one_plain_step_is_the_published_one(blob_engine: Any, blob_frame: Draw) -> None:
    # The context of 63.5 x 63.5 is 127: crop and frame have one scale, and no side has to be rounded.
    start: Box = (100.0, 80.0, 63.5, 63.5)  # centre 131.25, 111.25
    tracker = begun(blob_frame, start, plain=True)
    scores = np.zeros((17, 17), np.float32)
    scores[7, 10] = 0.8
    boxes = np.zeros((17, 17, 4), np.float32)
    boxes[:] = (0, 0, 62.5, 62.5)
    boxes[7, 10] = (167 - 63, 143 - 63, 167 + 63, 143 + 63)  # 127 x 127 pixels, 16 right of and 8 above the centre
    blob_engine.search = lambda *_: (scores, boxes)
    track = tracker.update(blob_frame(start))
    # Twice the size in the same shape: penalty exp(-k); rate 0.524964 * 0.947302 * 0.8 = 0.397841.
    side = 63.5 + 63.5 * 0.397841
    assert track.box == pytest.approx((147.25 - (side - 1) / 2, 103.25 - (side - 1) / 2, side, side), abs=1e-3)
    assert track.score == pytest.approx(0.8)


def test_plain_reports_the_network_and_nothing_else(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = begun(blob_frame, plain=True)
    tracks = [tracker.update(blob_frame(None)) for _ in range(3 * LOST_AFTER)]
    assert {t.state for t in tracks} == {"tracking"}
    assert [t.score for t in tracks] == pytest.approx([blob_engine.absent] * len(tracks))


def test_template_and_search_crops_are_laid_about_the_target(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = begun(blob_frame)
    tracker.update(blob_frame(START))
    tracker.update(blob_frame(START))
    # context sqrt((40 + 35)(30 + 35)) = 69.82, rounded 70: 40 of 70 pixels become 72.6 of 127
    (template,), searches = blob_engine.templates, blob_engine.searches
    assert template.shape == (127, 127, 3)
    assert (template[63, :, 0] > 147).sum() == pytest.approx(40 / 70 * 127, abs=2)
    assert [s.shape for s in searches] == [(303, 303, 3)] * 2
    assert (searches[0][151, :, 0] > 147).sum() == pytest.approx(40 / 70 * 127, abs=2)
    # outside the frame: the first frame's mean, whatever was drawn there
    grey = blob_frame(START).mean()
    begun(blob_frame, (0, 0, 40, 30)).update(blob_frame((0, 0, 40, 30)))
    assert blob_engine.searches[-1][0, 0] == pytest.approx([grey] * 3, abs=2)


# states


@pytest.mark.parametrize("peak", [0.4, 0.1])
def test_while_in_doubt_the_box_moves_as_in_the_published_procedure_and_keeps_its_size(
    blob_engine: Any, blob_frame: Draw, peak: float
) -> None:
    start = blob_frame(START)
    ours, plain = Tracker(), Tracker(plain=True)
    for tracker in (ours, plain):
        tracker.init(start, START)
    blob_engine.templates[:], ours.following._kernels, plain.following._kernels = blob_engine.templates[:1], 1, 1
    blob_engine.peak = peak
    for t in range(1, 30):
        frame = blob_frame((100 + 5 * t, 80 + t, 40 + t, 30 + t))
        track = ours.update(frame)
        assert track.state != "tracking"
        assert track.score == pytest.approx(peak, abs=1e-3)
        assert track.box[2:] == START[2:]
        assert centre_error(track.box, plain.update(frame).box) < 1


def test_a_target_that_is_hardly_recognised_is_followed_to_where_it_moved(blob_engine: Any, blob_frame: Draw) -> None:
    ours, plain = begun(blob_frame), begun(blob_frame, plain=True)
    scores = np.zeros((17, 17), np.float32)
    scores[8, 12] = 0.05
    boxes = np.full((17, 17, 4), (131, 131, 171, 171), np.float32)
    boxes[8, 12] += 32, 0, 32, 0
    blob_engine.search = lambda *_: (scores, boxes)
    # 32 pixels of the crop, of which 127 show 70 in the frame
    assert ours.update(blob_frame(START)).box[0] - START[0] == pytest.approx(32 * 70 / 127, abs=1)
    # there the published window, of height 1, decides for the middle
    assert plain.update(blob_frame(START)).box[0] - START[0] == pytest.approx(0, abs=1)


def test_where_nothing_has_a_score_the_box_stays(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = begun(blob_frame)
    boxes = np.zeros((17, 17, 4), np.float32)
    boxes[..., 0::2] = 131 + 8 * (np.arange(17) - 8)[None, :, None] + np.array([0, 40])
    boxes[..., 1::2] = 131 + 8 * (np.arange(17) - 8)[:, None, None] + np.array([0, 40])
    blob_engine.search = lambda *_: (np.zeros((17, 17), np.float32), boxes)
    assert tracker.update(blob_frame(START)).box == pytest.approx(START, abs=1)


def test_a_procedure_may_follow_sizes_in_doubt(blob_engine: Any, blob_frame: Draw) -> None:
    start = blob_frame(START)
    ours, plain = Tracker(), Tracker(plain=True)
    for tracker in (ours, plain):
        tracker.init(start, START)
    blob_engine.templates[:], ours.following._kernels, plain.following._kernels = blob_engine.templates[:1], 1, 1
    ours.following._procedure = dataclasses.replace(ours.following._procedure, rate_in_doubt=1.0)
    blob_engine.peak = 0.4
    for t in range(1, 5):
        frame = blob_frame((100 + 5 * t, 80 + t, 40 + t, 30 + t))
        assert ours.update(frame).box == plain.update(frame).box


def test_a_target_is_lost_in_a_scene_that_stands_still_too(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = begun(blob_frame)
    blob_engine.peak = 0.005
    frame = blob_frame((300, 220, 4, 4))
    assert [tracker.update(frame).state for _ in range(LOST_AFTER)][-1] == "lost"


def test_a_target_that_vanishes_in_motion_is_lost_and_awaited_where_it_was_going(
    blob_engine: Any, blob_frame: Draw
) -> None:
    tracker = begun(blob_frame)
    for t in range(1, 31):
        tracker.update(blob_frame((100 + 3 * t, 80 + t, 40, 30)))
    # it passes under something, where the network sees a weak likeness far from where the target goes
    blob_engine.peak = 0.05
    tracks = [tracker.update(blob_frame((100, 180, 40, 30))) for _ in range(LOST_AFTER + 2)]
    assert [t.state for t in tracks] == ["unsure"] * (LOST_AFTER - 1) + ["lost"] * 3
    blob_engine.peak = 0.95
    for t in range(41, 54):
        truth = (100 + 3 * t, 80 + t, 40, 30)
        track = tracker.update(blob_frame(truth))
    assert track.state == "tracking"
    assert centre_error(track.box, truth) < 1


def test_while_lost_the_box_is_the_best_guess(blob_engine: Any, blob_frame: Draw) -> None:
    # A network that doubts all the while and is right: the states must not cost what the plain procedure keeps.
    tracker = begun(blob_frame)
    blob_engine.peak = 0.1
    errors = []
    for t in range(1, 60):
        truth = (100 + t, 80 + t / 2, 40, 30)
        track = tracker.update(blob_frame(truth))
        errors.append(centre_error(track.box, truth))
    assert track.state == "lost"
    assert max(errors) < 3


@pytest.mark.parametrize("place", [(100, 80), (170, 80), (20, 150), (110, 5), (200, 140), (0, 0)])
def test_a_lost_target_is_found_again_within_reach(blob_engine: Any, blob_frame: Draw, place: tuple[int, int]) -> None:
    tracker = begun(blob_frame)
    for _ in range(LOST_AFTER + 3):
        tracker.update(blob_frame(None))
    truth = (*place, 40, 30)
    states = []
    while not states or (states[-1] == "lost" and len(states) < 320):
        track = tracker.update(blob_frame(truth))
        states.append(track.state)
    assert track.state == "tracking"
    assert centre_error(track.box, truth) < 1.5
    # and it goes on from there
    track = tracker.update(blob_frame((place[0] + 3, place[1] + 2, 40, 30)))
    assert track.state == "tracking"
    assert centre_error(track.box, (place[0] + 3, place[1] + 2, 40, 30)) < 1


def test_a_weak_find_elsewhere_does_not_take_a_lost_target_up(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = begun(blob_frame)
    for _ in range(LOST_AFTER):
        tracker.update(blob_frame(None))
    blob_engine.peak = 0.7
    assert {tracker.update(blob_frame((220, 180, 40, 30))).state for _ in range(60)} == {"lost"}


@pytest.mark.parametrize(("likeness", "changed"), [(0.93, True), (0.99, False)])
def test_what_was_taken_up_elsewhere_gives_way_to_a_better_find_at_the_expected_place(
    blob_engine: Any, blob_frame: Draw, monkeypatch: pytest.MonkeyPatch, likeness: float, changed: bool
) -> None:
    # no search region about either place reaches the other, and the other is a little darker
    other, see, count = (230, 170, 40, 30), blob_engine._see, itertools.count()

    def see_with_likeness(crop: Any) -> Any:
        blob_engine.peak = 0.995 if crop.max() > 240 else likeness
        return see(crop)

    monkeypatch.setattr(blob_engine, "_see", see_with_likeness)
    tracker = begun(blob_frame)
    for _ in range(LOST_AFTER):
        tracker.update(blob_frame(None))

    def shown(back: Box | None = None) -> Any:
        # every pixel flickers, since the same frame again would prove nothing
        return np.maximum(np.minimum(blob_frame(other), 230), blob_frame(back)) - np.uint8(next(count) % 2)

    for _ in range(320):
        if tracker.update(shown()).state == "tracking":
            break
    tracks = [tracker.update(shown(START)) for _ in range(10)]
    assert {t.state for t in tracks} == {"tracking"}
    assert [centre_error(t.box, other) < 1.5 for t in tracks] == [True] * 4 + [not changed] * 6
    assert [centre_error(t.box, START) < 1.5 for t in tracks[4:]] == [changed] * 6


@pytest.mark.parametrize(("frames", "state"), [(12, "tracking"), (5, "lost")])
def test_what_has_proved_to_be_the_target_is_expected_where_it_was_followed(
    blob_engine: Any, blob_frame: Draw, frames: int, state: str
) -> None:
    # The first place is still watched when the target is lost for the second time. A weak find ends that only where
    # the target is expected.
    other = (230, 170, 40, 30)
    tracker = begun(blob_frame)
    for _ in range(LOST_AFTER):
        tracker.update(blob_frame(None))
    for _ in range(320):
        if tracker.update(blob_frame(other)).state == "tracking":
            break
    for _ in range(frames - 1):
        tracker.update(blob_frame(other))
    for _ in range(LOST_AFTER):
        tracker.update(blob_frame(None))
    blob_engine.peak = 0.7
    assert tracker.update(blob_frame(other)).state == state


@pytest.mark.slow
def test_no_frame_costs_more_than_two_looks(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = begun(blob_frame)

    def looks(box: Box | None) -> int:
        before = len(blob_engine.searches)
        tracker.update(blob_frame(box))
        return len(blob_engine.searches) - before

    assert [looks(START) for _ in range(3)] == [1] * 3
    assert [looks(None) for _ in range(40)] == [1] * (SEARCH_AFTER - 1) + [2] * (41 - SEARCH_AFTER)
    assert max(looks((230, 170, 40, 30)) for _ in range(100)) == 2
    # the place where it was expected has been watched for long enough
    assert looks((230, 170, 40, 30)) == 1


@pytest.mark.slow
def test_a_find_must_be_like_later_looks_of_the_target_too(blob_engine: Any, blob_frame: Draw) -> None:
    search = blob_engine.search

    def search_by_look(crop: Any, kernels: int) -> Any:
        scores, boxes = search(crop, kernels)
        return (scores if kernels == 1 else np.full_like(scores, blob_engine.absent)), boxes

    blob_engine.search = search_by_look
    tracker = begun(blob_frame)
    for _ in range(3 * LOOK_EVERY):
        tracker.update(blob_frame(START))
    assert len(blob_engine.templates) == 4
    for _ in range(LOST_AFTER):
        tracker.update(blob_frame(None))
    boxes = [tracker.update(blob_frame((270, 200, 40, 30))).box for _ in range(60)]
    assert max(centre_error(box, START) for box in boxes) < 1
    blob_engine.search = search
    boxes = [tracker.update(blob_frame((270, 200, 40, 30))).box for _ in range(60)]
    assert centre_error(boxes[-1], (270, 200, 40, 30)) < 1


@pytest.mark.slow
def test_a_video_that_stands_still_proves_nothing(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = begun(blob_frame)
    for _ in range(LOST_AFTER):
        tracker.update(blob_frame(None))
    frame = blob_frame((230, 170, 40, 30))
    assert {tracker.update(frame).state for _ in range(200)} == {"lost"}


@pytest.mark.slow
def test_a_lost_target_is_not_looked_for_outside_the_frame(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = begun(blob_frame, (0, 0, 40, 30))
    for _ in range(100):
        tracker.update(blob_frame(None))
    fill = round(blob_frame((0, 0, 40, 30)).mean())
    # most of a region laid about a place outside the frame would be fill: half of each side is the most there is
    shares = [float((np.abs(s[..., 0].astype(int) - fill) <= 1).mean()) for s in blob_engine.searches]
    assert max(shares) < 0.8
    # whereas regions inside were looked at as well
    assert min(shares) < 0.1


# what users do


def test_a_tracker_can_take_up_another_target(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = begun(blob_frame)
    for _ in range(LOST_AFTER + 20):
        assert tracker.update(blob_frame(None)).box == pytest.approx(START, abs=2)
    other = (200, 150, 30, 36)
    assert tracker.init(blob_frame(other), other).state == "tracking"
    track = tracker.update(blob_frame((203, 151, 30, 36)))
    assert track.state == "tracking"
    assert centre_error(track.box, (203, 151, 30, 36)) < 1


def test_a_refused_start_leaves_the_old_target(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = begun(blob_frame)
    with pytest.raises(UserError):
        tracker.init(blob_frame(START), (1000, 1000, 10, 10))
    assert centre_error(tracker.update(blob_frame((103, 80, 40, 30))).box, (103, 80, 40, 30)) < 1


def test_frames_are_only_read(blob_engine: Any, blob_frame: Draw) -> None:
    frame = blob_frame(START)
    before = frame.copy()
    frame.flags.writeable = False
    tracker = Tracker()
    tracker.init(frame, START)
    tracker.update(frame)
    assert_array_equal(frame, before)


def test_frames_may_be_views_and_change_their_size(blob_engine: Any, blob_frame: Draw) -> None:
    tracker = begun(blob_frame)
    assert centre_error(tracker.update(blob_frame(START)[:, :, ::-1]).box, START) < 1
    track = tracker.update(blob_frame((102, 80, 40, 30), width=200, height=130))
    assert centre_error(track.box, (102, 80, 40, 30)) < 1
    # a frame that no longer holds the place of the target: the centre comes to its rim
    x, y, w, h = tracker.update(blob_frame(None, width=64, height=48)).box
    assert (x + (w - 1) / 2, y + (h - 1) / 2) == pytest.approx((64, 48))


def test_an_update_needs_a_target(blob_engine: Any, blob_frame: Draw) -> None:
    with pytest.raises(UserError, match=r"update\(\) before init\(\)"):
        Tracker().update(blob_frame(START))


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (np.zeros((240, 320, 3), np.float32), r"frame is float32 \(240, 320, 3\)"),
        (np.zeros((240, 320), np.uint8), r"frame is uint8 \(240, 320\)"),
        (np.zeros((240, 320, 4), np.uint8), r"frame is uint8 \(240, 320, 4\)"),
        (np.zeros((3, 240, 320), np.uint8), r"frame is uint8 \(3, 240, 320\)"),
        (np.zeros((0, 0, 3), np.uint8), r"frame is uint8 \(0, 0, 3\)"),
        (None, "frame is NoneType"),
        ([[0, 0, 0]], "frame is list"),
    ],
)
def test_frames_of_another_kind_are_refused(blob_engine: Any, blob_frame: Draw, frame: Any, message: str) -> None:
    tracker = begun(blob_frame)
    for call in (tracker.update, lambda f: tracker.init(f, START)):
        with pytest.raises(UserError, match=message):
            call(frame)


@pytest.mark.parametrize(
    "box", [(0, 0, 0, 0), (10, 10, -5, 5), (math.nan, 0, 5, 5), (500, 10, 20, 20), (10, 10, 20), (1e300, 0, 5, 5)]
)
def test_boxes_that_cannot_be_tracked_are_refused(blob_engine: Any, blob_frame: Draw, box: Any) -> None:
    with pytest.raises(UserError, match="box "):
        Tracker().init(blob_frame(START), box)


@pytest.mark.parametrize(
    "box", [(10, 10, 1, 1), (-399900, -399900, 8e5, 8e5), (0, 0, 320, 1), (100.5, 80.25, 39.5, 29)]
)
def test_odd_boxes_keep_every_number_finite(blob_engine: Any, blob_frame: Draw, box: Box) -> None:
    tracker = begun(blob_frame, box)
    for _ in range(3):
        track = tracker.update(blob_frame(START))
        assert all(math.isfinite(v) for v in (*track.box, track.score))
    assert blob_engine.templates[0].shape == (127, 127, 3)


def test_the_model_s_own_limits_are_used(tiny_model: Any, blob_frame: Draw) -> None:
    # a random network knows nothing; but whatever it says, the plain tracker says tracking
    tracker = begun(blob_frame, model=str(tiny_model), threads=1, search_size=239, plain=True)
    track = tracker.update(blob_frame(START))
    assert track.state == "tracking"
    assert 0 <= track.score <= 1
    assert tracker.spec.search_size == 239

"""What every correlation filter must do, on small generated clips."""

import sys

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("scipy")
pytest.importorskip("numba")

from psiamfcpp.errors import UserError
from psiamfcpp.trackers.dcf import FILTERS, open_dcf
from psiamfcpp.trackers.dcf.tracker import peak_to_sidelobe

HEIGHT, WIDTH = 120, 160
BOX = (60.0, 50.0, 24.0, 20.0)


def texture(height, width, seed):
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (height // 4 + 2, width // 4 + 2, 3), dtype=np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)


GROUND, TARGET = texture(HEIGHT, WIDTH, 1) // 2, texture(20, 24, 2)


def scene(x, y, factor=1.0):
    """A textured target with its corner at (x, y) before it grows by a factor about its centre, on a dim ground."""
    frame = GROUND.copy()
    w, h = round(24 * factor), round(20 * factor)
    left, top = round(x + 12 - w / 2), round(y + 10 - h / 2)
    frame[top : top + h, left : left + w] = cv2.resize(TARGET, (w, h), interpolation=cv2.INTER_LINEAR)
    return frame


def run(name, frames, box=BOX):
    tracker = open_dcf(name)
    tracker.init(frames[0], box)
    return np.array([tracker.update(frame).box for frame in frames[1:]])


def middle(boxes):
    return boxes[:, :2] + boxes[:, 2:] / 2


@pytest.fixture(params=FILTERS)
def name(request):
    return request.param


def test_a_target_that_does_not_move_keeps_its_box(name):
    boxes = run(name, [scene(60, 50)] * 6)
    assert np.abs(middle(boxes) - middle(np.array([BOX]))).max() <= 1.5
    assert np.abs(boxes[:, 2:] / BOX[2:] - 1).max() <= 0.06


def test_a_moving_target_is_followed(name):
    way = [(60 + 2 * i, 50 + i) for i in range(8)]
    boxes = run(name, [scene(x, y) for x, y in way])
    assert np.abs(middle(boxes) - np.array(way[1:]) - (12, 10)).max() <= 4.5  # KCF moves by whole cells of 4


def test_a_translated_clip_gives_translated_boxes(name):
    way = [(60 + i, 50 + 2 * i) for i in range(6)]
    frames = [scene(x, y) for x, y in way]
    # moved within a larger frame, whose borders stay out of the windows
    padded = [cv2.copyMakeBorder(f, 40, 40, 40, 40, cv2.BORDER_REPLICATE) for f in frames]
    moved = [np.roll(f, (8, 8), axis=(0, 1)) for f in padded]
    first = run(name, padded, (100.0, 90.0, 24.0, 20.0))
    second = run(name, moved, (108.0, 98.0, 24.0, 20.0))
    assert np.allclose(second - first, (8, 8, 0, 0), atol=1e-3)


@pytest.mark.parametrize("step", [1.015, 0.985])
def test_a_changing_scale_is_followed(name, step):
    if name == "kcf":
        pytest.skip("KCF has no scale")
    factors = step ** np.arange(16)
    boxes = run(name, [scene(60, 50, 2 * f if step < 1 else f) for f in factors], BOX if step > 1 else (48, 40, 48, 40))
    grown = boxes[-1, 2] / (24 if step > 1 else 48)
    assert abs(np.log(grown) - np.log(factors[-1])) < 0.6 * abs(np.log(factors[-1]))


def test_two_runs_give_equal_boxes(name):
    frames = [scene(60 + 3 * i, 50) for i in range(5)]
    assert np.array_equal(run(name, frames), run(name, frames))


def test_a_second_init_forgets_the_first_target(name):
    frames = [scene(60 + 2 * i, 50) for i in range(4)]
    tracker = open_dcf(name)
    tracker.init(texture(90, 70, 9), (10, 20, 30, 30))
    tracker.update(texture(90, 70, 9))
    tracker.init(frames[0], BOX)
    assert np.array_equal([tracker.update(f).box for f in frames[1:]], run(name, frames))


def test_frames_are_not_changed(name):
    frame = scene(60, 50)
    frame.flags.writeable = False
    run(name, [frame, frame])


def test_grey_frames_are_followed(name):
    frames = [
        np.ascontiguousarray(np.repeat(scene(60 + 2 * i, 50).mean(axis=2).astype(np.uint8)[..., None], 3, axis=2))
        for i in range(6)
    ]
    assert np.abs(middle(run(name, frames))[-1] - (82, 60)).max() <= 4.5


ODD = {
    "3px": ((120, 161), (50, 40, 3, 3)),
    "1px": ((120, 161), (50, 40, 1, 1)),
    "whole": ((121, 161), (0, 0, 161, 121)),
    "corner": ((121, 161), (-10, -10, 22, 22)),
    "edge": ((120, 160), (140, 100, 38, 38)),
    "flat": ((120, 160), (20, 60, 120, 3)),
    "tall": ((120, 160), (60, 5, 2, 110)),
    "small-frame": ((7, 9), (2, 2, 3, 3)),
    "one-pixel": ((1, 1), (0, 0, 1, 1)),
    "larger-than-frame": ((60, 60), (-60, -60, 180, 180)),
}


@pytest.mark.slow
def test_odd_targets_and_frames_give_finite_boxes(name):
    for what, (size, box) in ODD.items():
        frame = texture(*size, 3)
        tracker = open_dcf(name)
        tracker.init(frame, box)
        later = [
            frame,
            np.zeros_like(frame),
            np.full_like(frame, 255),
            texture(max(size[0] // 2, 1), size[1] + 3, 4),
            frame,
        ]
        for track in map(tracker.update, later):
            assert np.isfinite(track.box).all(), what
            assert min(track.box[2:]) > 0, what
            assert track.score is not None and np.isfinite(track.score), what
            assert track.state is None, what


@given(
    size=st.tuples(st.integers(5, 70), st.integers(5, 70)),
    centre=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    box=st.tuples(st.floats(1, 90), st.floats(1, 90)),
    seed=st.integers(0, 99),
)
@settings(max_examples=6, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
def test_no_size_and_no_place_raises(name, size, centre, box, seed):
    (height, width), (w, h) = size, box
    start = (centre[0] * (width - 1) - (w - 1) / 2, centre[1] * (height - 1) - (h - 1) / 2, w, h)
    tracker = open_dcf(name)
    tracker.init(texture(height, width, seed), start)
    for i in range(2):
        track = tracker.update(texture(height, width, seed + i))
        assert np.isfinite([*track.box, track.score]).all()


@pytest.mark.slow
def test_a_target_that_fills_a_4k_frame_is_followed(name):
    frame = cv2.resize(texture(135, 240, 6), (3840, 2160), interpolation=cv2.INTER_NEAREST)
    tracker = open_dcf(name)
    tracker.init(frame, (0, 0, 3840, 2160))
    track = tracker.update(frame)
    assert np.abs(np.array(track.box) - (0, 0, 3840, 2160)).max() < 160


# What all filters share refuses these, so one of them is asked.
@pytest.mark.parametrize("name", ["kcf"])
@pytest.mark.parametrize(
    ("box", "words"),
    [
        ((1, 2, 3), "four finite numbers"),
        ((1, 2, np.nan, 4), "four finite numbers"),
        ((1, 2, 0, 4), "holds no pixel"),
        ((500, 2, 9, 9), "outside the frame"),
    ],
)
def test_a_wrong_box_is_refused_and_the_target_before_is_released(name, box, words):
    tracker = open_dcf(name)
    with pytest.raises(UserError, match=words):
        tracker.init(scene(60, 50), box)
    with pytest.raises(UserError, match="init"):
        tracker.update(scene(60, 50))


@pytest.mark.parametrize("name", ["kcf"])
@pytest.mark.parametrize(
    "frame", [None, np.zeros((9, 9), np.uint8), np.zeros((9, 9, 3)), np.zeros((0, 9, 3), np.uint8)]
)
def test_a_wrong_frame_is_refused(name, frame):
    tracker = open_dcf(name)
    with pytest.raises(UserError, match="uint8, BGR"):
        tracker.init(frame, (1, 1, 5, 5))
    tracker.init(scene(60, 50), BOX)
    with pytest.raises(UserError, match="uint8, BGR"):
        tracker.update(frame)


@pytest.mark.parametrize("name", ["kcf"])
def test_a_closed_tracker_needs_a_new_target(name):
    tracker = open_dcf(name)
    tracker.init(scene(60, 50), BOX)
    tracker.close()
    tracker.close()
    with pytest.raises(UserError, match="init"):
        tracker.update(scene(60, 50))


def test_the_identity_names_filter_and_constants(name):
    identity = open_dcf(name).identity
    assert (identity["kind"], identity["name"]) == ("dcf", name)
    assert len(identity["constants"]) > 3
    assert open_dcf(name).name == f"dcf-{name}"


def test_an_unknown_filter_is_refused():
    with pytest.raises(UserError, match="'csrt' is not known: choose from kcf"):
        open_dcf("csrt")


@pytest.mark.parametrize("module", ["scipy", "numba"])
def test_a_missing_extra_is_named(monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UserError, match=rf"need {module}: pip install 'psiamfcpp\[dcf\]'"):
        open_dcf("kcf")


@pytest.mark.parametrize(
    ("width", "ratio"),
    [(1, 3.0), (4, 3.0)],
)
def test_the_score_is_the_peak_above_the_sidelobe_in_deviations(width, ratio):
    # a sidelobe of +-1 with mean 0 outside a peak of height 3
    response = np.where(np.add.outer(np.arange(80), np.arange(80)) % 2, 1.0, -1.0)
    response[40, 40 - width // 2 : 40 + (width + 1) // 2] = 3
    assert peak_to_sidelobe(response) == pytest.approx(ratio, abs=0.01)
    # the response is cyclic
    assert peak_to_sidelobe(np.roll(response, (40, 40), (0, 1))) == pytest.approx(peak_to_sidelobe(response))


def test_a_flat_response_has_no_score():
    assert peak_to_sidelobe(np.ones((9, 9))) == 0
    assert peak_to_sidelobe(np.ones((1, 1))) == 0


# Middles and sizes in the last frame of `scene(60 + 2 i, 50 + i, 1.01 ** i)`, i = 0 ... 9.
FROZEN = {
    "kcf": (88.0, 68.0, 24.0, 20.0),
    "fdsst": (89.0, 68.0, 24.0, 20.0),
    "staple-ca": (90.43, 69.65, 24.0, 20.0),
    "bacf": (90.0, 69.0, 24.0, 20.0),
    "eco-hc": (90.0, 70.0, 26.0, 22.0),
    "mcct-h": (89.59, 68.71, 26.0, 22.0),
    "strcf": (90.0, 69.0, 24.0, 20.0),
    "arcf-hc": (90.5, 69.5, 25.0, 21.0),
    "autotrack": (90.0, 69.0, 25.0, 21.0),
}


def test_boxes_on_a_generated_clip_stay_as_they_are(name):
    boxes = run(name, [scene(60 + 2 * i, 50 + i, 1.01**i) for i in range(10)])
    assert [*middle(boxes)[-1], *boxes[-1, 2:]] == pytest.approx(FROZEN[name], abs=0.51)

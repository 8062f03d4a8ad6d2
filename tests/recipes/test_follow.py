"""`psiamfcpp.follow`: what it yields for sources, boxes and trackers of every kind."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import psiamfcpp
from psiamfcpp import Track, UserError
from psiamfcpp.geometry import Image

Draw = Callable[..., Image]
PATH = [(100.0 + 3 * t, 80.0 + t, 40.0, 30.0) for t in range(6)]


def test_frames_give_one_track_per_box(blob_engine: Any, blob_frame: Draw) -> None:
    frames = [blob_frame(box) for box in PATH]
    found = list(psiamfcpp.follow(frames, [PATH[0]]))
    assert found[0] == [Track(PATH[0], 1.0, "tracking")]
    assert [tracks[0].box for tracks in found] == [pytest.approx(box, abs=1.5) for box in PATH]


def test_a_folder_of_images_is_a_source(blob_engine: Any, blob_sequence: Callable[..., Path]) -> None:
    root = blob_sequence("car", PATH)
    found = list(psiamfcpp.follow(str(root / "car" / "img"), [PATH[0], PATH[0]]))
    assert [len(tracks) for tracks in found] == [2] * len(PATH)


def test_other_trackers_follow_too(blob_frame: Draw) -> None:
    frames = [blob_frame(box) for box in PATH[:3]]
    found = list(psiamfcpp.follow(frames, [PATH[0], (10, 10, 30, 30)], tracker="opencv:mil"))
    assert [[track.score for track in tracks] for tracks in found] == [[None, None]] * 3
    assert found[-1][1].box[2:] == (30, 30)


def test_frames_are_taken_one_by_one(blob_engine: Any, blob_frame: Draw) -> None:
    taken = []

    def frames():  # type: ignore[no-untyped-def]
        for box in PATH:
            taken.append(box)
            yield blob_frame(box)

    tracks = psiamfcpp.follow(frames(), [PATH[0]])
    next(tracks)
    next(tracks)
    assert len(taken) == 2


@pytest.mark.parametrize(
    ("boxes", "message"),
    [([], "boxes is empty"), ([(1, 2, 3)], "not four finite numbers"), ([(900, 5, 20, 20)], "outside the frame")],
)
def test_wrong_boxes_are_refused(blob_engine: Any, blob_frame: Draw, boxes: list[Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        list(psiamfcpp.follow([blob_frame(PATH[0])], boxes))

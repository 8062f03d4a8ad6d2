"""Where a target that is out of sight is looked for, and what proves that it was found."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from psiamfcpp.spec import Calibration
from psiamfcpp.trackers.siamfcpp.camera import STILL
from psiamfcpp.trackers.siamfcpp.hunt import Hunt
from psiamfcpp.trackers.siamfcpp.procedure import Target

PLACE, FAR = Target(100, 80, 40, 30), Target(300, 200, 40, 30)
SHAPE = (360, 640, 3)
LIMITS = Calibration(unsure_below=0.5, lost_below=0.01, regain_above=0.9)


def test_the_place_goes_on_as_the_target_did_and_stops() -> None:
    hunt = Hunt(PLACE, (3, -1))
    for _ in range(100):
        hunt.go_on(STILL)
    assert hunt.place == Target(190, 50, 40, 30)


def test_the_place_stays_in_the_world_while_the_camera_pans() -> None:
    # The target stood still in the world: what it moved in the frame was the camera's motion, and still is.
    hunt, pan = Hunt(PLACE, (-6, 2)), np.array([[1.0, 0, -6], [0, 1, 2]])
    hunt.go_on(STILL)
    for _ in range(9):
        hunt.go_on(pan)
    assert (hunt.place.cx, hunt.place.cy) == pytest.approx((40, 100))
    hunt.go_on(np.array([[1.0, 0, 50], [0, 1, 0]]))
    assert (hunt.place.cx, hunt.place.cy) == pytest.approx((90, 100))


def none(side: float) -> list[tuple[float, float]]:
    return []


def test_the_place_what_moves_and_tiles_that_cover_the_frame_are_looked_at_in_turn() -> None:
    hunt = Hunt(PLACE, (0, 0))
    sides = []

    def movers(side: float) -> list[tuple[float, float]]:
        sides.append(side)
        return [(50.0, 60.0), (500.0, 300.0)]

    looks = [hunt.aim(40, SHAPE, movers) for _ in range(800)]
    assert looks[::4] == [PLACE] * 200
    assert looks[2::4] == [Target(50, 60, 40, 30), Target(500, 300, 40, 30)] * 100
    assert sides == [pytest.approx(np.sqrt(40 * 30))] * 200
    tiles = looks[1::2]
    first = [t for t in tiles if t.w == tiles[0].w]
    distances = [np.hypot(t.cx - PLACE.cx, t.cy - PLACE.cy) for t in first]
    count = next(i for i, (a, b) in enumerate(pairwise(distances), 1) if b < a)
    assert distances[:count] == sorted(distances[:count])
    reach = 40 * first[0].w / PLACE.w
    x, y = np.meshgrid(np.arange(640), np.arange(360))
    near = [np.maximum(abs(x - t.cx), abs(y - t.cy)) <= reach for t in first[:count]]
    assert np.any(near, axis=0).all()
    assert len({t.w for t in tiles}) == 3


def test_a_place_outside_the_frame_is_not_looked_at() -> None:
    hunt = Hunt(Target(-50, 80, 40, 30), (0, 0))
    looks = [hunt.aim(40, SHAPE, none) for _ in range(50)]
    assert all(0 <= t.cx < 640 and 0 <= t.cy < 360 for t in looks)


@pytest.mark.parametrize(
    ("place", "values", "leads", "won"),
    [
        (FAR, [0.95] * 5, [0.1] * 5, 5),
        (FAR, [0.95] * 4, [0.1] * 4, None),
        (FAR, [0.95] * 9, [0.0] * 9, None),
        (FAR, [0.85] * 9, [0.5] * 9, None),
        # at the place more likely than not is enough to begin with
        (PLACE, [0.6, 0.6] + [0.95] * 5, [0.5] * 7, 7),
        # one look that speaks against it, and it has to begin anew
        (FAR, [0.95] * 4 + [0.4] + [0.95] * 5, [0.5] * 10, 10),
        (FAR, [0.95] * 12, [-0.1] * 6 + [0.1] * 6, 9),
    ],
)
def test_a_rival_is_proved_by_five_frames(
    place: Target, values: list[float], leads: list[float], won: int | None
) -> None:
    hunt = Hunt(PLACE, (0, 0))
    results = [hunt.judge(place, value, lead, LIMITS) for value, lead in zip(values, leads, strict=True)]
    assert (results.index(True) + 1 if True in results else None) == won


def test_a_rival_is_followed_and_one_that_cannot_lead_given_up() -> None:
    hunt = Hunt(PLACE, (0, 0))
    for number in range(25):
        hunt.judge(FAR, 0.95, -0.1, LIMITS)
        assert hunt.rival and hunt.aim(40, SHAPE, none) == FAR, number
    hunt.judge(FAR, 0.95, -0.1, LIMITS)
    assert hunt.rival is None

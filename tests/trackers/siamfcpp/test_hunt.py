"""Where a target that is out of sight is looked for, and what proves that it was found."""

from __future__ import annotations

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


def distance(look: Target, x: float, y: float) -> float:
    return float(np.hypot(look.cx - x, look.cy - y))


def test_the_expected_place_is_looked_at_first_and_again_and_soon_everything() -> None:
    hunt = Hunt(PLACE, (0, 0))
    looks = []
    for _ in range(400):
        hunt.go_on(STILL)
        looks.append(hunt.aim(40, SHAPE, none))
    assert distance(looks[0], PLACE.cx, PLACE.cy) < 40
    near = [distance(look, PLACE.cx, PLACE.cy) < 60 for look in looks]
    assert all(any(near[i : i + 40]) for i in range(0, 400, 40))
    x, y = np.meshgrid(np.arange(640), np.arange(360))
    seen = [np.maximum(abs(x - t.cx), abs(y - t.cy)) <= 40 * t.w / PLACE.w for t in looks]
    # all but single pixels at the rim
    assert np.any(seen, axis=0).mean() > 0.999
    assert {t.w for t in looks} == {40 * size for size in (1.0, 1.3, 1.7)}


def test_what_moves_by_itself_is_looked_at_before_the_rest_of_the_frame() -> None:
    hunt, sides = Hunt(PLACE, (0, 0)), []

    def movers(side: float) -> list[tuple[float, float]]:
        sides.append(side)
        return [(500.0, 300.0)]

    looks = []
    for _ in range(12):
        hunt.go_on(STILL)
        looks.append(hunt.aim(40, SHAPE, movers))
    assert any(distance(look, 500, 300) < 40 for look in looks)
    assert sides == [pytest.approx(np.sqrt(40 * 30))] * 12


def test_where_was_looked_moves_with_the_camera() -> None:
    # One look on the expected place; then the camera jumps, so that the place is where nothing was looked at.
    pan = np.array([[1.0, 0, 200], [0, 1, 100]])
    hunt = Hunt(PLACE, (0, 0))
    hunt.go_on(STILL)
    first = hunt.aim(40, SHAPE, none)
    hunt.go_on(pan)
    second = hunt.aim(40, SHAPE, none)
    assert distance(second, first.cx + 200, first.cy + 100) >= 20
    assert distance(second, hunt.place.cx, hunt.place.cy) < 100


def test_a_place_outside_the_frame_is_not_looked_at() -> None:
    hunt = Hunt(Target(-50, 80, 40, 30), (0, 0))
    looks = [hunt.aim(40, SHAPE, none) for _ in range(50)]
    assert all(0 <= t.cx < 640 and 0 <= t.cy < 360 for t in looks)


@pytest.mark.parametrize(
    ("values", "followed", "won"),
    [
        ([0.95] * 5, [0.2] * 5, 5),
        ([0.95] * 4, [0.2] * 4, None),
        # what is followed is as good
        ([0.95] * 9, [0.95] * 9, None),
        # better than what is followed, and not enough to be the target
        ([0.8] * 9, [0.1] * 9, None),
        # more likely than not is enough to begin with
        ([0.6, 0.6] + [0.95] * 5, [0.1] * 7, 6),
        # one look that speaks against it, and it has to begin anew
        ([0.95] * 4 + [0.4] + [0.95] * 5, [0.1] * 10, 10),
        # what is followed was hardly visible and comes back
        ([0.95] * 9, [0.1] * 4 + [0.8] * 5, None),
        ([0.95] * 9, [0.1] * 4 + [0.7] * 5, 5),
    ],
)
def test_a_rival_is_proved_by_five_frames(values: list[float], followed: list[float], won: int | None) -> None:
    hunt = Hunt(PLACE, (0, 0))
    results = [hunt.judge(FAR, value, other, LIMITS) for value, other in zip(values, followed, strict=True)]
    assert (results.index(True) + 1 if True in results else None) == won


def test_a_rival_is_followed_and_one_that_cannot_lead_given_up() -> None:
    hunt = Hunt(PLACE, (0, 0))
    for number in range(12):
        hunt.judge(FAR, 0.95, 0.96, LIMITS)
        assert hunt.rival and hunt.aim(40, SHAPE, none) == FAR, number
    hunt.judge(FAR, 0.95, 0.96, LIMITS)
    assert hunt.rival is None

"""Who wins when a target was taken up elsewhere than expected."""

from __future__ import annotations

import pytest

from psiamfcpp.trackers.siamfcpp.contest import Contest
from psiamfcpp.trackers.siamfcpp.procedure import Target

PLACE = Target(100, 80, 40, 30)
FOUND = Target(104, 79, 44, 33)


@pytest.mark.parametrize(
    ("looks", "won"),
    [
        ([(True, 0.1)] * 5, 5),
        ([(True, 0.1)] * 4, None),
        ([(True, 0.0)] * 6, None),
        ([(True, -0.1)] * 3 + [(True, 0.2)] * 2, 5),
        ([(True, -0.1)] * 20 + [(True, 0.1)] * 5, 23),
        ([(True, 0.1)] * 4 + [(False, 0.1)] + [(True, 0.1)] * 5, 10),
        ([(False, 0.1)] * 25, None),
    ],
)
def test_five_sure_looks_in_a_row_that_lead_together_win(looks: list[tuple[bool, float]], won: int | None) -> None:
    contest = Contest(PLACE, (0, 0))
    results = [contest.judge(FOUND, sure, lead) for sure, lead in looks]
    assert (results.index(True) + 1 if True in results else None) == won


def test_the_place_goes_on_as_the_target_did_until_a_find_draws_it() -> None:
    contest = Contest(PLACE, (3, -1))
    contest.judge(FOUND, sure=False, lead=0.2)
    assert contest.place == Target(103, 79, 40, 30)
    contest.judge(FOUND, sure=True, lead=-0.2)
    # the size is that of the target when it was last seen
    assert contest.place == Target(103.5, 79, 40, 30)


def test_it_ends() -> None:
    contest = Contest(PLACE, (0, 0))
    for _ in range(25):
        assert contest.looks_left > 0
        contest.judge(FOUND, sure=False, lead=0)
    assert contest.looks_left == 0

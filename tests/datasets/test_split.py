from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiamfcpp.datasets import Sequence
from psiamfcpp.datasets.split import split


def clip(name: str, frames: int = 2) -> Sequence:
    return Sequence(name, [Path(f"{name}/{k}.jpg") for k in range(frames)], np.ones((frames, 4)))


def names(sequences: list[Sequence]) -> list[str]:
    return [s.name for s in sequences]


CLIPS = [clip(f"clip{i}") for i in range(200)]


def test_the_crc_of_the_name_decides():
    # CRC-32 of car1 is 219495848 and that of car3 is 3810221188; those of the others are no multiples of 4.
    training, held_out = split([clip(f"car{i}") for i in range(1, 8)], 4)
    assert names(held_out) == ["car1", "car3"]
    assert names(training) == ["car2", "car4", "car5", "car6", "car7"]


@pytest.mark.parametrize("every", [2, 4, 8])
def test_about_one_in_so_many_is_held_out(every: int):
    training, held_out = split(CLIPS, every)
    assert len(held_out) / len(CLIPS) == pytest.approx(1 / every, abs=0.08)
    assert sorted(names(training) + names(held_out)) == sorted(names(CLIPS))


@pytest.mark.parametrize("every", [0, 1])
def test_none_and_all(every: int):
    training, held_out = split(CLIPS, every)
    assert (training, held_out) == ((CLIPS, []) if every == 0 else ([], CLIPS))


@pytest.mark.parametrize("every", [0, 1, 2, 8])
def test_photographs_are_never_held_out(every: int):
    photos = [clip(f"photo{i}", frames=1) for i in range(50)]
    assert split(photos, every) == (photos, [])


@given(st.lists(st.text(max_size=6), unique=True), st.lists(st.text(max_size=6), unique=True), st.integers(1, 5))
def test_more_data_moves_no_clip_to_the_other_side(some: list[str], more: list[str], every: int):
    before = split([clip(name) for name in some], every)
    after = split([clip(name) for name in dict.fromkeys([*more, *some])], every)
    assert set(names(before[0])) <= set(names(after[0]))
    assert set(names(before[1])) <= set(names(after[1]))


def test_what_is_cut_from_one_video_stays_together():
    # CRC-32 of road is 3 more than a multiple of 4, that of car1 a multiple; so the numbers behind count for nothing.
    clips = [clip(f"{name}_{number}") for name in ("road", "car1") for number in (0, 120, 240)]
    tracks = [dataclasses.replace(clip(f"car1_0_t{track}"), clip="car1_0") for track in range(3)]
    training, held_out = split([*clips, *tracks], 4)
    assert names(training) == ["road_0", "road_120", "road_240"]
    assert names(held_out) == ["car1_0", "car1_120", "car1_240", "car1_0_t0", "car1_0_t1", "car1_0_t2"]


@given(st.text(max_size=6), st.integers(0, 10**6), st.integers(0, 10**6), st.integers(2, 5))
def test_numbers_at_the_end_of_a_name_move_nothing(name: str, one: int, two: int, every: int):
    sides = [len(split([clip(f"{name}_{number}")], every)[1]) for number in (one, two)]
    assert sides[0] == sides[1]


def test_the_order_stays():
    training, held_out = split(CLIPS, 3)
    assert training == [c for c in CLIPS if c in training]
    assert held_out == [c for c in CLIPS if c in held_out]


def test_two_clips_of_one_name_stay_together():
    training, held_out = split([clip("same"), clip("same")], 2)
    assert sorted((len(training), len(held_out))) == [0, 2]

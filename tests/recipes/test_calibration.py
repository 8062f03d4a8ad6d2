"""Calibration: on looks drawn from known distributions, and on a tracker that sees a blob."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from psiamfcpp import Tracker, UserError, datasets
from psiamfcpp.recipes.calibration import LOST_BELOW, UNSURE_BELOW, Looks, confidences, cross_rates, fit, gather
from psiamfcpp.spec import Calibration
from trackers.test_lightfc import BlobLightFC


def looks(apart: float, count: int = 1500, clips: int = 6, seed: int = 0) -> Looks:
    """As many with the target as without; logit of the peak and contrast lie ``apart`` standard deviations apart."""
    rng = np.random.default_rng(seed)
    found = np.arange(2 * count) % 2 == 0
    logit, contrast = (rng.normal(np.where(found, apart / 2, -apart / 2), 1) for _ in range(2))
    return Looks(1 / (1 + np.exp(-logit)), contrast, found, ~found, np.arange(2 * count) // 2 % clips)


def test_fit_recovers_what_parts_the_two_kinds() -> None:
    # Two normal distributions at +-1 with variance 1 have log odds of 2 x: the exact answer is known.
    drawn = looks(2.0, count=20000)
    calibration = fit(drawn)
    assert calibration.bias == pytest.approx(0, abs=0.1)
    assert calibration.score_weight == pytest.approx(2, abs=0.1)
    assert calibration.contrast_weight == pytest.approx(2, abs=0.1)
    values = confidences(drawn, calibration)
    assert values[drawn.found].mean() > 0.85
    assert values[drawn.absent].mean() < 0.15
    # calibrated: among looks that are given about 0.7, about 0.7 have the target
    about = (values > 0.6) & (values < 0.8)
    assert drawn.found[about].mean() == pytest.approx(values[about].mean(), abs=0.05)


def test_both_kinds_weigh_the_same_however_many_there_are() -> None:
    drawn = looks(2.0, count=20000)
    keep = drawn.found | (np.arange(len(drawn.found)) % 10 == 1)  # one in five of those without
    fewer = Looks(*(column[keep] for column in dataclasses.astuple(drawn)))
    assert fewer.absent.sum() == drawn.absent.sum() / 5
    assert fit(fewer).bias == pytest.approx(fit(drawn).bias, abs=0.2)


def test_limits_are_the_stated_ones() -> None:
    drawn = looks(2.0)
    calibration = fit(drawn)
    values = confidences(drawn, calibration)
    assert (calibration.unsure_below, calibration.lost_below) == (UNSURE_BELOW, LOST_BELOW)
    assert (values[drawn.absent] >= calibration.regain_above).mean() == pytest.approx(0.005, abs=0.002)


def test_a_confidence_is_a_probability_when_both_kinds_are_as_many() -> None:
    drawn = looks(2.0)
    values = confidences(drawn, fit(drawn))
    near = (values > 0.25) & (values < 0.35)
    assert drawn.found[near].mean() == pytest.approx(0.3, abs=0.06)


@pytest.mark.parametrize("apart", [0.5, 2.0, 12.0])
def test_what_is_doubted_at_once_is_never_taken_up_again(apart: float) -> None:
    calibration = fit(looks(apart))
    assert calibration.regain_above >= calibration.lost_below


def test_looks_that_missed_their_target_are_left_out_of_the_fit() -> None:
    drawn = looks(2.0)
    missed = dataclasses.replace(drawn, found=drawn.found.copy())
    missed.found[:200:2] = False
    assert not (missed.found | missed.absent).all()
    others = (missed.found | missed.absent).nonzero()[0]
    assert fit(missed) == fit(Looks(*(column[others] for column in dataclasses.astuple(missed))))


@pytest.mark.parametrize("kind", ["found", "absent"])
def test_both_kinds_are_needed(kind: str) -> None:
    drawn = looks(2.0)
    with pytest.raises(UserError, match="calibration found no frame"):
        fit(dataclasses.replace(drawn, **{kind: np.zeros_like(drawn.found)}))


def test_kinds_far_apart_leave_the_fit_finite_and_the_rates_clean() -> None:
    drawn = looks(12.0)
    calibration = fit(drawn)
    assert np.isfinite(dataclasses.astuple(calibration)).all()
    rates = cross_rates(drawn)
    assert rates.hit == 1
    assert rates.false_regain == 0
    assert (rates.false_alarm, rates.unsure, rates.regain) == (0, 0, 1)
    assert (rates.clips, rates.found_frames, rates.absent_frames) == (6, 1500, 1500)


def test_kinds_that_cannot_be_told_apart_show_in_the_rates() -> None:
    rates = cross_rates(looks(0.0))
    # no better than chance: as many doubted without the target as with it
    assert rates.hit == pytest.approx(rates.false_alarm, abs=0.03)
    assert rates.hit < 0.1


def test_rates_are_those_of_unseen_clips() -> None:
    """Every even clip looks like no odd one: limits fitted on one half mean nothing on the other."""
    drawn = looks(6.0)
    shifted = np.where(drawn.clip % 2 == 0, drawn.contrast + 30, drawn.contrast)
    assert cross_rates(drawn).false_alarm < 0.1
    rates = cross_rates(dataclasses.replace(drawn, contrast=shifted))
    assert rates.false_alarm > 0.3 or rates.false_regain > 0.3


def test_confidences_are_one_a_row() -> None:
    drawn = looks(2.0, count=10)
    values = confidences(drawn, Calibration())
    assert values == pytest.approx(drawn.peak)


# gathering

# So fast that a region laid about any label but the one before would not hold the blob: it reaches 37 px.
PATH = [(60.0 + 30 * t, 80.0 + 2 * t, 40.0, 30.0) for t in range(5)]


@pytest.fixture
def clips(blob_sequence: Callable[..., Path]) -> list[datasets.Sequence]:
    blob_sequence("car1", PATH)
    return datasets.read("folder", blob_sequence("car2", [(x + 60, y + 40, 30, 36) for x, y, _, _ in PATH]))


# with some other seeds no place far enough from the target turns up in twenty draws, and rows are missing
@pytest.mark.parametrize("seed", range(3))
def test_gather_sees_targets_where_they_are_and_nothing_where_they_are_not(
    blob_engine: Any, clips: list[datasets.Sequence], seed: int
) -> None:
    rows = gather(Tracker(plain=True), clips, seed)
    assert len(rows.peak) == len(rows.contrast) == len(rows.found) == len(rows.absent) == len(rows.clip)
    # frames 2 to 5 of both clips, each with its target once
    present = ~rows.absent
    assert present.sum() == rows.found.sum() == 8
    assert rows.peak[present] == pytest.approx(0.95, abs=1e-3)
    assert rows.contrast[present].min() > 3
    assert not (rows.found & rows.absent).any()
    assert list(rows.clip) == [0] * 16 + [1] * 16
    # after each, without it: covered, elsewhere in the frame, and in the other clip
    assert list(rows.absent) == [False, True, True, True] * 8
    # the first two do take it out of sight; in the other clip the place may happen to be that of its own target
    assert rows.peak[1::4] == pytest.approx(0.02)
    assert rows.peak[2::4] == pytest.approx(0.02)


def test_gather_looks_as_the_procedure_of_the_architecture_does(clips: list[datasets.Sequence]) -> None:
    # The engine checks the sizes of the crops, and finds the blob only where the crop shows it.
    rows = gather(Tracker(engine=BlobLightFC()), clips)
    assert rows.found.sum() == 8 and rows.absent.sum() == 24
    assert rows.peak[rows.found] == pytest.approx(0.9, abs=1e-3)
    # 0.01 is the engine's background; of the other clip's frames some show a blob
    assert np.median(rows.peak[rows.absent]) == pytest.approx(0.01)


@pytest.mark.slow
def test_gather_is_reproducible(blob_engine: Any, clips: list[datasets.Sequence]) -> None:
    a, b, c = (gather(Tracker(plain=True), clips, seed) for seed in (3, 3, 4))
    assert_array_equal(a.peak, b.peak)
    assert not np.array_equal(a.peak, c.peak)


def test_gather_calls_a_box_beside_the_target_not_found(blob_engine: Any, clips: list[datasets.Sequence]) -> None:
    search = blob_engine.search
    blob_engine.search = lambda *call: (search(*call)[0], search(*call)[1] + np.float32(60))
    rows = gather(Tracker(plain=True), clips)
    assert not rows.found.any()


def test_gather_passes_over_frames_without_a_label(blob_engine: Any, clips: list[datasets.Sequence]) -> None:
    clips[0].boxes[[0, 3]] = np.nan
    clips[1].boxes[1:] = 0
    rows = gather(Tracker(plain=True), clips)
    # of the first clip frames 3 and 5 (2 is where it begins); the second has one label only
    assert (~rows.absent).sum() == 2
    assert set(rows.clip) == {0}


def test_gather_needs_two_clips_with_labels(blob_engine: Any, clips: list[datasets.Sequence]) -> None:
    tracker = Tracker(plain=True)
    for few in ([], clips[:1]):
        with pytest.raises(UserError, match=f"at least two clips, {len(few)} given"):
            gather(tracker, few)
    for clip in clips:
        clip.boxes[1:] = np.nan
    with pytest.raises(UserError, match="none of 2 has two labelled frames"):
        gather(tracker, clips)

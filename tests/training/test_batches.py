from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest
import torch

from psiamfcpp.datasets import Sequence
from psiamfcpp.errors import UserError
from psiamfcpp.training.batches import Batch, collate, numbered_batches
from psiamfcpp.training.options import PairOptions
from psiamfcpp.training.pairs import Pair, PairSampler


class Counting(PairSampler):
    """Pairs that tell their number."""

    def __init__(self) -> None:
        pass

    def pair(self, index: int) -> Pair:
        blank = np.zeros((3, 3, 3), np.uint8)
        return Pair(blank, blank, (float(index), 0.0, 1.0, 1.0), True)


def numbers(**given: int) -> list[list[int]]:
    arguments = {"batch": 3, "start": 0, "end": 4, "workers": 0, **given}
    return [batch.corners[:, 0].int().tolist() for batch in numbered_batches(Counting(), **arguments)]


def test_one_process_takes_pairs_in_order():
    assert numbers() == [[0, 1, 2], [3, 4, 5], [6, 7, 8], [9, 10, 11]]


@pytest.mark.parametrize("start", [1, 3, 4])
@pytest.mark.parametrize("ranks", [1, 2])
def test_a_later_start_is_the_tail(start: int, ranks: int):
    assert numbers(start=start, ranks=ranks) == numbers(ranks=ranks)[start:]


def test_two_processes_part_each_step():
    assert numbers(rank=0, ranks=2) == [[0, 1, 2], [6, 7, 8], [12, 13, 14], [18, 19, 20]]
    assert numbers(rank=1, ranks=2) == [[3, 4, 5], [9, 10, 11], [15, 16, 17], [21, 22, 23]]


@pytest.mark.parametrize("ranks", [2, 3, 5])
def test_processes_together_see_what_one_with_their_batches_would(ranks: int):
    parts = [numbers(rank=rank, ranks=ranks) for rank in range(ranks)]
    together = [[number for part in step for number in part] for step in zip(*parts, strict=True)]
    assert together == numbers(batch=3 * ranks)


class Unreadable(Counting):
    """Pairs of which one cannot be made."""

    def pair(self, index: int) -> Pair:
        if index == 4:
            raise UserError("image gone.jpg does not exist")
        return super().pair(index)


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_an_image_that_cannot_be_read_is_said_as_it_is(workers: int):
    found = numbered_batches(Unreadable(), 3, 0, 4, workers=workers)
    assert next(found).corners[:, 0].tolist() == [0, 1, 2]
    with pytest.raises(UserError) as caught:
        next(found)
    assert str(caught.value) == "image gone.jpg does not exist"


def test_no_room_for_what_loader_processes_read_is_one_line(monkeypatch: pytest.MonkeyPatch):
    def full(_path: Path, _content: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(UserError, match=r"sampler cannot be written \(No space left on device\): free disk space"):
        next(numbered_batches(Counting(), 3, 0, 4, workers=1))


def equal(a: Batch, b: Batch) -> bool:
    return all(torch.equal(getattr(a, k), getattr(b, k)) for k in ("template", "search", "corners", "present"))


@pytest.mark.slow
def test_a_loader_process_changes_nothing(scenes: list[Sequence]):
    sampler = PairSampler(scenes, PairOptions(search_size=191, negatives=0.3), seed=2)
    here = list(numbered_batches(sampler, 2, 1, 4, workers=0))
    there = list(numbered_batches(sampler, 2, 1, 4, workers=1))
    assert len(here) == len(there) == 3
    assert all(equal(a, b) for a, b in zip(here, there, strict=True))


@pytest.fixture
def batch(scenes: list[Sequence]) -> Batch:
    sampler = PairSampler(scenes, PairOptions(search_size=191, negatives=0.5), seed=2)
    return collate([sampler.pair(i) for i in range(3)])


def test_collate_stacks_pairs(scenes: list[Sequence], batch: Batch):
    sampler = PairSampler(scenes, PairOptions(search_size=191, negatives=0.5), seed=2)
    for i in range(3):
        pair = sampler.pair(i)
        assert np.array_equal(batch.template[i].numpy(), pair.template)
        assert np.array_equal(batch.search[i].numpy(), pair.search)
        assert batch.corners[i].tolist() == pytest.approx(pair.corners)
        assert bool(batch.present[i]) is pair.present


def test_inputs_keep_levels_and_channel_order(batch: Batch):
    for images, inputs in ((batch.template, batch.template_input()), (batch.search, batch.search_input())):
        size = images.shape[1]
        assert inputs.shape == (3, 3, size, size)
        assert inputs.dtype == torch.float32
        assert inputs.is_contiguous(memory_format=torch.channels_last)
        assert inputs[1, :, 5, 7].tolist() == images[1, 5, 7].tolist()


def test_to_moves_every_part(batch: Batch):
    moved = batch.to(torch.device("meta"))
    assert {t.device.type for t in (moved.template, moved.search, moved.corners, moved.present)} == {"meta"}

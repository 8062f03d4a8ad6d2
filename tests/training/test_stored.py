"""What a stored teacher says, with a teacher that sees a coloured blob, and the loss on it by hand."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from psiamfcpp.datasets import Sequence
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import from_corners, overlap
from psiamfcpp.models.network import cell_grid
from psiamfcpp.training.batches import numbered_batches
from psiamfcpp.training.loop import train
from psiamfcpp.training.options import PairOptions, TeacherOptions
from psiamfcpp.training.pairs import PairSampler
from psiamfcpp.training.stored import CELLS, StoredMaps, lightfc, on_cells, say, store, stored_loss

from .conftest import coloured
from .test_loop import RUN, network, options

PLAIN = PairOptions(search_size=239, negatives=0.0, augmentation=0.0, shift=0.25)


def blob(template: np.ndarray, region: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """LightFC as it should be: finds what has the colour of the template's middle."""
    shade = tuple(int(v) for v in template[64, 64])
    rows, columns = np.nonzero(coloured(region, shade))  # type: ignore[arg-type]
    score, size, offset = np.zeros((16, 16), np.float32), np.zeros((2, 16, 16)), np.zeros((2, 16, 16))
    if not len(rows):
        return score, size, offset
    # In cells of 16 pixels of the region, which begins half a pixel before the middle of its first one.
    middle = (np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2 + 0.5) / 16
    column, row = np.clip(np.round(middle), 0, 15).astype(int)
    score[row, column] = 0.8
    offset[:, row, column] = middle - (column, row)
    size[:, row, column] = (np.ptp(columns) + 1) / 256, (np.ptp(rows) + 1) / 256
    return score, size, offset


@pytest.fixture
def sampler(scenes: list[Sequence]) -> PairSampler:
    return PairSampler(scenes, PLAIN, seed=3)


@pytest.mark.parametrize("size", [239, 303])
def test_the_teachers_box_comes_back_in_pixels_of_the_search_crop(scenes: list[Sequence], size: int):
    sampler = PairSampler(scenes, dataclasses.replace(PLAIN, search_size=size))
    for pair in (sampler.pair(i) for i in range(12)):
        said = say(blob, pair)
        assert overlap(from_corners(said.corners), from_corners(pair.corners)) > 0.85
        middle = (np.array(pair.corners[:2]) + np.array(pair.corners[2:])) / 2
        assert (said.corners[:2] + said.corners[2:]) / 2 == pytest.approx(middle, abs=2.5)
        assert said.trust == pytest.approx(0.8)
        # Four times the root of the target's area in a crop without jitter of scale.
        assert said.side == pytest.approx(4 * 63.5, rel=0.07)


def test_the_cell_with_the_highest_score_is_at_the_box(sampler: PairSampler):
    for pair in (sampler.pair(i) for i in range(12)):
        said = say(blob, pair)
        on_ours = on_cells(torch.tensor(said.score)[None], torch.tensor(said.side)[None], 239, 9)
        best = cell_grid(239, 9).reshape(-1, 2)[on_ours.flatten().argmax()].numpy()
        assert best == pytest.approx((said.corners[:2] + said.corners[2:]) / 2, abs=8 + 4)


@pytest.mark.parametrize("change", [{"present": False}, {"side": 9.9}, {"corners": (0.0, 0.0, 30.0, 30.0)}])
def test_what_is_not_trusted(sampler: PairSampler, change: dict[str, Any]):
    pair = sampler.pair(0)
    assert say(blob, pair).trust > 0
    assert say(blob, dataclasses.replace(pair, **change)).trust == 0


def test_scores_fall_on_our_cells_by_place():
    """One cell at a time: the value is found where that cell lies, and half of it half a cell away."""
    score = torch.zeros(1, 16, 16)
    score[0, 8, 8] = 1.0  # the middle of the region, which is that of the crop
    ours = on_cells(score, torch.tensor([256.0]), 303, 17)[0]
    assert ours[8, 8] == pytest.approx(1, abs=1e-5)
    assert [ours[8, k].item() for k in (7, 9, 10)] == pytest.approx([0.5, 0.5, 0], abs=1e-5)
    score = torch.zeros(1, 16, 16)
    score[0, 8, 10] = 1.0  # 32 pixels further right
    ours = on_cells(score, torch.tensor([256.0]), 303, 17)[0]
    assert ours[8].argmax() == 8 + 4


def test_outside_of_the_region_nothing_is_said():
    ours = on_cells(torch.ones(1, 16, 16), torch.tensor([60.0]), 303, 17)[0]
    assert ours[8, 8] == pytest.approx(1)
    assert ours[0].abs().max() == 0 and ours[:, 16].abs().max() == 0


# ---- storing


def test_what_is_stored_is_what_was_said(sampler: PairSampler, tmp_path: Path):
    store(tmp_path / "maps" / "a.safetensors", blob, sampler, [4, 5])
    store(tmp_path / "maps" / "b.safetensors", blob, sampler, [9])
    stored = StoredMaps(tmp_path / "maps", PLAIN, 3)
    assert len(stored) == 3
    for number in (9, 4, 5):
        found, said = stored.get(number), say(blob, sampler.pair(number))
        for field in dataclasses.fields(said):
            assert np.array_equal(getattr(found, field.name), getattr(said, field.name))
    assert stored.get(6).trust == 0


@pytest.mark.parametrize(("changed", "seed"), [({}, 4), ({"search_size": 303}, 3), ({"negatives": 0.5}, 3)])
def test_maps_of_other_pairs_are_refused(sampler: PairSampler, tmp_path: Path, changed: dict[str, Any], seed: int):
    store(tmp_path / "a.safetensors", blob, sampler, [0])
    with pytest.raises(UserError, match=r"a\.safetensors are of other pairs"):
        StoredMaps(tmp_path, dataclasses.replace(PLAIN, **changed), seed)


def test_folders_without_maps(tmp_path: Path):
    with pytest.raises(UserError, match="holds no teacher maps"):
        StoredMaps(tmp_path, PLAIN, 0)
    (tmp_path / "a.safetensors").write_bytes(b"none")
    with pytest.raises(UserError, match=r"a\.safetensors cannot be read"):
        StoredMaps(tmp_path, PLAIN, 0)


def test_a_teacher_that_is_none(tmp_path: Path):
    (tmp_path / "a.onnx").write_bytes(b"none")
    with pytest.raises(UserError, match=r"teacher .*a\.onnx, .*a\.onnx cannot be opened"):
        lightfc(tmp_path / "a.onnx", tmp_path / "a.onnx")


def test_batches_carry_what_is_stored(sampler: PairSampler, tmp_path: Path):
    store(tmp_path / "a.safetensors", blob, sampler, [1, 2])
    (batch,) = numbered_batches(sampler, 3, 0, 1, workers=0, stored=StoredMaps(tmp_path, PLAIN, 3))
    assert batch.said is not None
    scores, sides, corners, trust = batch.said
    assert [tuple(t.shape) for t in (scores, sides, corners, trust)] == [(3, CELLS, CELLS), (3,), (3, 4), (3,)]
    assert trust.tolist() == pytest.approx([0, 0.8, 0.8])
    assert batch.to(torch.device("cpu")).said is not None
    (plain,) = numbered_batches(sampler, 3, 0, 1, workers=0)
    assert plain.said is None


# ---- the loss


def maps(cls: list[float], distance: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Maps of one row of two cells, high centre-ness."""
    shape = (1, 1, 2)
    return torch.tensor([[cls]]), torch.full(shape, 50.0), torch.full((*shape, 4), distance)


INSIDE = torch.ones(1, 1, 2, dtype=torch.bool)
SIZE = 191


def test_the_place_is_a_divergence_of_shares(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("psiamfcpp.training.stored.cell_grid", lambda *_: torch.zeros(1, 2, 2))
    logit = math.log(0.2 / 0.8)
    box = torch.tensor([[-10.0, -10, 10, 10]])
    found = maps([logit, logit], 10.0)
    said = torch.tensor([[[0.6, 0.3]]])
    value = stored_loss(found, said, box, torch.tensor([1.0]), INSIDE, SIZE).item()
    # The squares 0.36 and 0.09 are shares of 4/5 and 1/5; the network gives both half.
    assert value == pytest.approx(0.8 * math.log(1.6) + 0.2 * math.log(0.4), abs=1e-5)
    alike = maps([math.log(0.4 / 0.6), math.log(0.1 / 0.9)], 10.0)
    assert stored_loss(alike, said, box, torch.tensor([1.0]), INSIDE, SIZE).item() == pytest.approx(0, abs=1e-5)
    # Half the sides overlap by a quarter.
    small = (*alike[:2], alike[2] / 2)
    assert stored_loss(small, said, box, torch.tensor([1.0]), INSIDE, SIZE).item() == pytest.approx(
        math.log(4), abs=1e-5
    )


def test_pairs_without_trust_count_for_nothing():
    found = tuple(torch.randn(2, 3, 3) for _ in range(2))
    distances = torch.rand(2, 3, 3, 4) * 20 + 1
    wanted, corners = torch.rand(2, 3, 3), torch.tensor([[60.0, 60, 120, 120], [0.0, 0, 9, 9]])
    inside = torch.ones(2, 3, 3, dtype=torch.bool)
    alone = stored_loss(
        (found[0][:1], found[1][:1], distances[:1]), wanted[:1], corners[:1], torch.ones(1), inside[:1], 207
    )
    both = stored_loss((*found, distances), wanted, corners, torch.tensor([0.7, 0.0]), inside, 207)
    assert both.item() == pytest.approx(alone.item(), rel=1e-5)
    none = stored_loss((*found, distances), wanted, corners, torch.zeros(2), inside, 207)
    assert none.item() == 0


@pytest.mark.slow
def test_training_with_stored_maps(scenes: list[Sequence], tmp_path: Path):
    pairs = PairOptions(search_size=191, negatives=0.0, augmentation=0.0)
    store(tmp_path / "maps" / "a.safetensors", blob, PairSampler(scenes, pairs, 0), range(16))
    chosen = options(2, pairs=pairs, batch=8, teacher=TeacherOptions(stored=str(tmp_path / "maps"), stored_weight=2.0))
    (row,) = train(network(), scenes, [], tmp_path / "run", chosen, RUN)
    labels = row["cls"] + row["centerness"] + 3 * row["iou"]
    assert row["stored"] > 0
    assert row["total"] == pytest.approx(labels + 2 * row["stored"], rel=1e-5)

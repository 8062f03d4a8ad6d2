"""LightFC asked in every step says what a stored LightFC says."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from psiamfcpp.datasets import Sequence
from psiamfcpp.errors import UserError
from psiamfcpp.models import save
from psiamfcpp.training.asked import ask, open_asked
from psiamfcpp.training.batches import Batch, collate
from psiamfcpp.training.loop import train
from psiamfcpp.training.options import PairOptions, TeacherOptions
from psiamfcpp.training.pairs import PairSampler
from psiamfcpp.training.stored import say

from .test_lightfc import narrow
from .test_loop import RUN, network, options


class Sure:
    """Says of every region that the target fills a quarter of its side about the middle, and keeps what it is shown."""

    def __init__(self) -> None:
        self.seen: list[Tensor] = []

    def template(self, z: Tensor) -> Tensor:
        self.seen.append(z)
        return z

    features = template

    def maps(self, x: Tensor, _kernels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        score = torch.full((len(x), 1, 16, 16), 0.1)
        score[:, 0, 8, 8] = 0.8
        return score, torch.full((len(x), 2, 16, 16), 0.25), torch.zeros(len(x), 2, 16, 16)


@pytest.mark.parametrize("size", [239, 303])
def test_lightfc_is_shown_what_it_is_shown_pair_by_pair(scenes: list[Sequence], size: int):
    sampler = PairSampler(scenes, PairOptions(search_size=size), seed=3)
    pairs = [sampler.pair(i) for i in range(6)]
    one_by_one: list[list[np.ndarray]] = []

    def look(*crops: np.ndarray) -> tuple[np.ndarray, ...]:
        one_by_one.append([crop.astype(float) for crop in crops])
        score, side, offset = model.maps(torch.zeros(1), torch.zeros(1))
        return score[0, 0].numpy(), side[0].numpy(), offset[0].numpy()

    model = Sure()
    said = [say(look, pair) for pair in pairs]
    told = ask(model, collate(pairs)).said  # type: ignore[arg-type]
    assert told is not None
    for number, (alone, seen) in enumerate(zip(said, one_by_one, strict=True)):
        for crop, together in zip(seen, model.seen, strict=True):
            # Crops are rounded to grey levels only where they are stored.
            assert np.abs(together[number].permute(1, 2, 0).numpy() - crop).mean() < 1
        assert told[1][number].item() == pytest.approx(float(alone.side), rel=1e-5)
        assert told[2][number].numpy() == pytest.approx(alone.corners, abs=1e-2)
        assert told[3][number].item() == pytest.approx(float(alone.trust))


# Cells 8 and 8 begin in the middle of a crop of 271 pixels.
MIDDLE = torch.tensor([[103.5, 103.5, 166.5, 166.5]])


@pytest.mark.parametrize(
    ("changed", "trust"),
    [
        ({}, 0.8),
        ({"present": torch.tensor([False])}, 0),
        ({"side": torch.tensor([9.9])}, 0),
        ({"corners": MIDDLE + 30}, 0),
    ],
)
def test_what_is_trusted(changed: dict[str, Any], trust: float):
    """Not a box that misses the label by half, a negative pair or a target of few pixels."""
    images = (torch.zeros(1, size, size, 3, dtype=torch.uint8) for size in (127, 271))
    batch = Batch(*images, MIDDLE, torch.tensor([True]), torch.tensor([10.0]))
    said = ask(Sure(), dataclasses.replace(batch, **changed)).said  # type: ignore[arg-type]
    assert said is not None
    assert said[3].item() == pytest.approx(trust)
    assert said[2][0].numpy() == pytest.approx(MIDDLE[0].numpy(), abs=1)


def test_only_a_lightfc_is_asked(tmp_path: Path):
    save(tmp_path / "ours.safetensors", network())
    with pytest.raises(UserError, match=r"ours\.safetensors is of architecture siamfcpp-alexnet: give a LightFC"):
        open_asked(tmp_path / "ours.safetensors", torch.device("cpu"))


@pytest.mark.slow
def test_a_run_learns_from_the_model_that_it_names(scenes: list[Sequence], tmp_path: Path):
    save(tmp_path / "lightfc.safetensors", narrow(0))
    chosen = dataclasses.replace(options(2), teacher=TeacherOptions(stored=str(tmp_path / "lightfc.safetensors")))
    rows = list(train(network(), scenes, [], tmp_path / "run", chosen, RUN))
    assert all("stored" in row for row in rows)

"""What LightFC is trained to, and runs of it with a teacher."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from psiamfcpp.crop import warp
from psiamfcpp.datasets import Sequence
from psiamfcpp.errors import UserError
from psiamfcpp.images import read_image
from psiamfcpp.models import load, save
from psiamfcpp.models.arch import architecture
from psiamfcpp.models.lightfc import LightFC
from psiamfcpp.spec import ModelSpec
from psiamfcpp.trackers.lightfc import crop
from psiamfcpp.trackers.siamfcpp.procedure import Target
from psiamfcpp.training.batches import Batch
from psiamfcpp.training.lightfc import labelled, overlap, peaks, taught
from psiamfcpp.training.loop import train
from psiamfcpp.training.options import LossWeights, PairOptions, RunOptions, Schedule, TeacherOptions, TrainOptions
from psiamfcpp.training.pairs import Jitter, PairSampler, crop_map
from psiamfcpp.training.teacher import answer, open_teacher
from psiamfcpp.training.validation import held_out_batches, pair_score

ARCH = architecture("lightfc")
PLAIN = PairOptions(search_size=256, augmentation=0.0, negatives=0.0)
NOTHING = LossWeights(cls_weight=0, centerness_weight=0, iou_weight=0)
OPTIONS = TrainOptions(PLAIN, Schedule(steps=2, lr=1e-3, backbone_lr=1.0), NOTHING, batch=2, ema=0.0)
RUN = RunOptions(bf16=False, workers=0, validation_pairs=4)


def narrow(seed: int, width: int = 4) -> LightFC:
    """A LightFC of few filters, with random weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        spec = ModelSpec(dict.fromkeys(ARCH.groups, width), 128, 256, calibration=None, architecture="lightfc")
        return LightFC(spec).eval()


def batch(*corners: tuple[float, float, float, float], present: bool = True) -> Batch:
    images = (torch.zeros(len(corners), side, side, 3, dtype=torch.uint8) for side in (128, 256))
    count = (len(corners),)
    return Batch(*images, torch.tensor(corners), torch.full(count, present), torch.full(count, 40.0))


def maps(
    score: torch.Tensor, sides: tuple[float, float] = (0.25, 0.25), offset: float = 0.5
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Maps whose boxes are of the same sides in all cells, about the cells' middles."""
    size = torch.tensor(sides)[None, :, None, None].expand(len(score), 2, 16, 16)
    return score[:, None], size, torch.full((len(score), 2, 16, 16), offset)


@pytest.mark.parametrize("size", [128, 256])
def test_crops_are_those_of_the_tracker(scenes: list[Sequence], size: int) -> None:
    image = read_image(scenes[0].frames[0])
    # A square of 30 has a template of 60 pixels, which needs no rounding.
    found = warp(image, crop_map(np.array([60.0, 50, 30, 30]), size, Jitter(), ARCH), size, (0, 0, 0))
    wanted = crop(image, Target(74.5, 64.5, 30, 30), size, 128, (0, 0, 0))
    assert np.abs(found.astype(int) - wanted).max() <= 1


def test_pairs_are_those_of_the_architecture(scenes: list[Sequence]) -> None:
    pair = PairSampler(scenes, PLAIN, arch=ARCH).pair(0)
    assert pair.template.shape == (128, 128, 3) and pair.search.shape == (256, 256, 3)
    x0, y0, x1, y1 = pair.corners
    # A quarter of the crop, times up to 1.3 either way; the corners are the middles of pixels.
    assert 46 <= math.sqrt((x1 - x0 + 1) * (y1 - y0 + 1)) <= 85
    # Outside the frame all is black: half a crop and the largest shift reach beyond the frame's upper edge.
    low = Sequence("low", scenes[0].frames[:1], np.array([[90.0, 5, 30, 30]]), "clip")
    shown = PairSampler([low], dataclasses.replace(PLAIN, shift=0.0), arch=ARCH).pair(0).search
    assert (shown[:4] == 0).all() and shown[128].any()
    with pytest.raises(UserError, match="search size 303"):
        PairSampler(scenes, dataclasses.replace(PLAIN, search_size=303), arch=ARCH)


def test_the_peak_is_at_the_cell_that_holds_the_centre() -> None:
    # The centre is 104 pixels from the left edge and 56 from the upper one: 6.5 and 3.5 cells.
    found = peaks(torch.tensor([[80.0, 40, 127, 71]]), torch.tensor([True]), 256, 16)
    assert found.shape == (1, 16, 16) and found[0, 3, 6] == 1 and (found == 1).sum() == 1
    # 48 pixels are 3 cells wide, a tenth of which is the deviation, but at least a third of a cell.
    assert float(found[0, 3, 7]) == pytest.approx(math.exp(-4.5), rel=1e-3)
    wide = peaks(torch.tensor([[0.0, 0, 255, 255]]), torch.tensor([True]), 256, 16)
    assert float(wide[0, 8, 10]) == pytest.approx(math.exp(-(2**2) / (2 * 1.6**2)), rel=1e-3)


def test_there_is_no_peak_without_a_target_or_outside_the_crop() -> None:
    inside, outside = (10.0, 10.0, 50.0, 50.0), (300.0, 10.0, 350.0, 50.0)
    assert peaks(torch.tensor([inside]), torch.tensor([False]), 256, 16).sum() == 0
    assert peaks(torch.tensor([outside]), torch.tensor([True]), 256, 16).sum() == 0


def test_labels_are_met_by_their_peak_and_box() -> None:
    corners = (72.0, 24.0, 135.0, 87.0)  # centre 104, 56: the middle of cell (3, 6); side 64
    given = batch(corners)
    peak = peaks(given.corners, given.present, 256, 16)
    good = labelled(maps(peak.clamp(1e-4, 1 - 1e-4)), given, LossWeights())
    # Cells beside the peak weigh little, but their boxes are off by a cell.
    assert good["cls"] < 0.05 and good["iou"] < 0.25
    assert float(good["total"]) == pytest.approx(float(good["cls"] + 3 * good["iou"]))
    small = labelled(maps(peak.clamp(1e-4, 1 - 1e-4), (0.125, 0.25)), given, LossWeights())
    assert small["iou"] > good["iou"] + 0.4
    nowhere = labelled(maps(torch.full((1, 16, 16), 1e-4)), given, LossWeights())
    assert nowhere["cls"] > 5
    everywhere = labelled(maps(torch.full((1, 16, 16), 0.9)), batch(corners, present=False), LossWeights())
    assert everywhere["cls"] > 100 and everywhere["iou"] == 0


def test_a_teacher_equalled_is_no_loss_and_scores_count_where_it_scores() -> None:
    wanted = torch.full((1, 16, 16), 0.01)
    wanted[0, 3, 6] = 0.9
    given = batch((72.0, 24.0, 135.0, 87.0))
    assert taught(maps(wanted), maps(wanted), given) == pytest.approx(0, abs=1e-6)
    missed, ghost = wanted.clone(), wanted.clone()
    missed[0, 3, 6], ghost[0, 12, 12] = 0.2, 0.2
    losses = [float(taught(maps(score), maps(wanted), given)) for score in (missed, ghost)]
    assert losses[0] > 5 * losses[1] > 0
    # All boxes are half as wide: overlap 0.5.
    assert float(taught(maps(wanted, (0.125, 0.25)), maps(wanted), given)) == pytest.approx(math.log(2), rel=1e-3)


def test_overlap_counts_the_last_column_and_row() -> None:
    a, b = torch.tensor([0.0, 0, 9, 9]), torch.tensor([5.0, 0, 14, 9])
    assert float(overlap(a, b)) == pytest.approx(50 / 150)
    assert float(overlap(a, torch.tensor([20.0, 0, 29, 9]))) == 0


@pytest.fixture
def teacher(tmp_path: Path) -> Path:
    save(tmp_path / "teacher.safetensors", narrow(1, 6))
    return tmp_path / "teacher.safetensors"


@pytest.mark.slow
def test_a_run_with_a_teacher_resumes_to_the_bit(scenes: list[Sequence], teacher: Path, tmp_path: Path) -> None:
    chosen = dataclasses.replace(OPTIONS, teacher=TeacherOptions(str(teacher), 1.0, 1.0))
    start = narrow(0)
    (row,) = train(narrow(0), scenes[4:], scenes[:1], tmp_path / "straight", chosen, RUN)
    assert row["teacher"] > 0 and row["features"] > 0
    assert row["total"] == pytest.approx(row["teacher"] + row["features"], rel=1e-5)
    assert 0 <= row["validation"]["overlap"] <= 1
    list(
        train(
            narrow(0), scenes[4:], [], tmp_path / "run", chosen, dataclasses.replace(RUN, save_every=1, max_time=1e-9)
        )
    )
    list(train(narrow(5), scenes[4:], [], tmp_path / "run", chosen, RUN))
    found = [load(tmp_path / folder / "model.safetensors").state_dict() for folder in ("straight", "run")]
    for name, value in found[0].items():
        assert torch.equal(value, found[1][name])
        # Every layer learns, as the table freezes none; biases of layers that are silent here have no gradient.
        assert value.ndim < 4 or not torch.equal(value, start.state_dict()[name]), name


@pytest.mark.slow
def test_it_comes_nearer_to_its_teacher(scenes: list[Sequence], teacher: Path, tmp_path: Path) -> None:
    chosen = dataclasses.replace(
        OPTIONS, schedule=Schedule(steps=50, lr=1e-2, backbone_lr=1.0), teacher=TeacherOptions(str(teacher))
    )
    list(train(narrow(0), scenes, [], tmp_path / "run", chosen, RUN))
    (given,) = held_out_batches(scenes, PLAIN, 4, 4, arch=ARCH)
    look = open_teacher(str(teacher), torch.device("cpu"), "lightfc")
    with torch.no_grad():
        wanted = look(given).maps
        before, after = (
            float(taught(answer(network, given).maps, wanted, given))
            for network in (narrow(0), load(tmp_path / "run" / "model.safetensors"))
        )
    assert after < 0.7 * before
    assert 0 <= pair_score(narrow(0), [given]).overlap <= 1


def test_what_does_not_fit_is_refused(scenes: list[Sequence], tiny_model: Path, tmp_path: Path) -> None:
    for taught_by, said in (
        (
            TeacherOptions(str(tiny_model)),
            "is of architecture siamfcpp-alexnet, whose maps differ",
        ),
        (TeacherOptions(stored=str(tmp_path)), "lightfc cannot learn from stored maps"),
    ):
        chosen = dataclasses.replace(OPTIONS, teacher=taught_by)
        with pytest.raises(UserError, match=said):
            next(train(narrow(0), scenes, [], tmp_path / "run", chosen, RUN))

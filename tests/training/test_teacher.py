"""The teacher's term by hand, and training with it."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from psiamfcpp.datasets import Sequence
from psiamfcpp.errors import UserError
from psiamfcpp.models import load, save
from psiamfcpp.models.network import Maps
from psiamfcpp.training.loop import PairLoss, train
from psiamfcpp.training.options import LossWeights, PairOptions, TeacherOptions, TrainOptions
from psiamfcpp.training.teacher import Answer, feature_loss, open_teacher, teacher_loss
from psiamfcpp.training.validation import held_out_batches

from .test_loop import RUN, network, options, weights


def maps(cls: float, centerness: float, distance: float, size: int = 3) -> Maps:
    shape = (2, size, size)
    return torch.full(shape, 1.0 * cls), torch.full(shape, 1.0 * centerness), torch.full((*shape, 4), 1.0 * distance)


def positive(*cells: tuple[int, int, int]) -> torch.Tensor:
    inside = torch.zeros(2, 3, 3, dtype=torch.bool)
    for cell in cells:
        inside[cell] = True
    return inside


def divergence(p: float, q: float) -> float:
    """Of a coin that the teacher gives q, when p is learned."""
    return q * math.log(q / p) + (1 - q) * math.log((1 - q) / (1 - p))


LOG3 = math.log(3)  # logit of 0.75


def test_no_loss_where_the_maps_are_the_teachers() -> None:
    assert teacher_loss(maps(0.3, -1, 20), maps(0.3, -1, 20), positive((0, 1, 1))).item() == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("mine", "wanted", "expected"),
    [
        # Class off everywhere: once for positive cells, once for background cells.
        ((0, 0, 10), (LOG3, 0, 10), 2 * divergence(0.5, 0.75)),
        ((LOG3, 0, 10), (0, 0, 10), 2 * divergence(0.75, 0.5)),
        ((0, LOG3, 10), (0, -LOG3, 10), 2 * divergence(0.75, 0.25)),
        # Boxes of half the sides overlap by a quarter, whatever the teacher's score.
        ((0, 0, 5), (0, 0, 10), math.log(4)),
        ((-3, -3, 20), (-3, -3, 10), math.log(4)),
    ],
)
def test_loss_of_constant_maps(mine: Any, wanted: Any, expected: float) -> None:
    assert teacher_loss(maps(*mine), maps(*wanted), positive((0, 1, 1))).item() == pytest.approx(expected, rel=1e-4)


def test_one_positive_cell_weighs_as_much_as_all_background() -> None:
    inside = positive((1, 0, 2))
    wrong_inside, wrong_outside = maps(0, 0, 10), maps(0, 0, 10)
    wrong_inside[0][1, 0, 2] = LOG3
    wrong_outside[0][~inside] = LOG3
    teacher = maps(0, 0, 10)
    found = [teacher_loss(m, teacher, inside).item() for m in (wrong_inside, wrong_outside)]
    assert found == pytest.approx([divergence(0.75, 0.5)] * 2, rel=1e-4)


def test_boxes_count_where_the_teacher_is_sure() -> None:
    teacher, mine = maps(-20, 20, 10), maps(-20, 20, 10)
    teacher[0][0, 0, 0] = mine[0][0, 0, 0] = 20
    mine[2][0, 0, 1] = 1
    assert teacher_loss(mine, teacher, positive((0, 0, 0))).item() == pytest.approx(0, abs=1e-5)
    mine[2][0, 0, 0] = 5
    assert teacher_loss(mine, teacher, positive((0, 0, 0))).item() == pytest.approx(math.log(4), rel=1e-4)


def test_batches_without_a_target_have_a_finite_loss() -> None:
    mine = tuple(m.requires_grad_() for m in maps(0, 0, 5))
    loss = teacher_loss(mine, maps(LOG3, 0, 10), positive())  # type: ignore[arg-type]
    loss.backward()
    assert loss.item() == pytest.approx(divergence(0.5, 0.75) + math.log(4), rel=1e-4)
    assert all(torch.isfinite(m.grad).all() for m in mine)  # type: ignore[arg-type]


def seen(template: Any, search: Any) -> Answer:
    """Features of one channel in two crops each."""
    shaped = (torch.tensor(values, dtype=torch.float32).reshape(2, 1, 1, -1) for values in (template, search))
    return Answer(*shaped, maps(0, 0, 10))


@pytest.mark.parametrize(
    ("mine", "expected"),
    [
        (seen([1, 3, 1, 3], [0, 0, 8, 8]), 0),
        (seen([2, 2, 2, 2], [4, 4, 4, 4]), 1),
        # Off by 1 where the variance is 1, in templates alone; by 2 where it is 16, in search crops alone.
        (seen([2, 4, 2, 4], [0, 0, 8, 8]), 1 / 2),
        (seen([1, 3, 1, 3], [2, 2, 10, 10]), 4 / 16 / 2),
    ],
)
def test_features_are_compared_in_units_of_their_variance(mine: Answer, expected: float) -> None:
    assert feature_loss(mine, seen([1, 3, 1, 3], [0, 0, 8, 8])).item() == pytest.approx(expected)


def test_features_that_never_vary_give_a_finite_loss() -> None:
    assert math.isfinite(feature_loss(seen([1, 1], [2, 2]), seen([1, 1], [2, 3])).item())


@pytest.fixture
def taught(scenes: list[Sequence], tmp_path: Path) -> Any:
    """Runs training with a wider network as teacher."""
    teacher = tmp_path / "teacher.safetensors"
    save(teacher, network(9))

    def begin(chosen: TrainOptions, folder: str = "run", **run: Any) -> Iterator[dict[str, Any]]:
        chosen = dataclasses.replace(chosen, teacher=TeacherOptions(str(teacher)))
        return train(network(), scenes[4:], [], tmp_path / folder, chosen, dataclasses.replace(RUN, **run))

    return begin


@pytest.mark.slow
def test_a_run_with_a_teacher_resumes_to_the_bit(taught: Any, tmp_path: Path) -> None:
    list(taught(options(6), folder="straight"))
    killed = taught(options(6), save_every=3)
    assert next(killed)["teacher"] > 0
    killed.close()
    (row,) = taught(options(6), save_every=3)
    assert row["step"] == 6
    straight, resumed = tmp_path / "straight", tmp_path / "run"
    assert (straight / "model.safetensors").read_bytes() == (resumed / "model.safetensors").read_bytes()


def test_the_teacher_stays_as_it_is_and_out_of_the_model(taught: Any, tmp_path: Path) -> None:
    before = (tmp_path / "teacher.safetensors").read_bytes()
    list(taught(options(2)))
    assert (tmp_path / "teacher.safetensors").read_bytes() == before
    assert weights(tmp_path / "run").keys() == network().state_dict().keys()
    assert torch.load(tmp_path / "run" / "state.pt", weights_only=True)["model"].keys() == network().state_dict().keys()


@pytest.mark.slow
def test_a_network_comes_nearer_to_its_teacher(scenes: list[Sequence], tmp_path: Path) -> None:
    path = tmp_path / "teacher.safetensors"
    save(path, network(9))
    plain = PairOptions(search_size=191, augmentation=0.0)
    (batch,) = held_out_batches(scenes, plain, 8, 8)
    teacher = open_teacher(str(path), torch.device("cpu"))
    nothing = LossWeights(cls_weight=0, centerness_weight=0, iou_weight=0)

    def apart(folder: str) -> float:
        with torch.no_grad():
            module = PairLoss(load(tmp_path / folder / "model.safetensors").train(), nothing, teacher)
            return float(module(batch)["teacher"])

    chosen = options(30, lr=5e-3, batch=4, pairs=plain, ema=0.0, losses=nothing)
    for folder, steps in (("little", 1), ("much", 30)):
        schedule = dataclasses.replace(chosen.schedule, steps=steps)
        final = dataclasses.replace(chosen, schedule=schedule, teacher=TeacherOptions(str(path), 2.0))
        list(train(network(), scenes, [], tmp_path / folder, final, RUN))
    assert apart("much") < 0.5 * apart("little")


def test_the_total_holds_the_weighted_term(scenes: list[Sequence], tmp_path: Path) -> None:
    save(tmp_path / "teacher.safetensors", network(9))
    teacher = open_teacher(str(tmp_path / "teacher.safetensors"), torch.device("cpu"))
    (batch,) = held_out_batches(scenes, PairOptions(search_size=191, augmentation=0.0), 4, 4)
    labels = {"cls": 1, "centerness": 1, "iou": 3}
    for taught, shares in (
        (TeacherOptions("x", 0.5), {**labels, "teacher": 0.5}),
        (TeacherOptions("x", 0.5, 2.0), {**labels, "teacher": 0.5, "features": 2}),
    ):
        parts = PairLoss(network(9).eval(), LossWeights(1, 1, 3), teacher, taught)(batch)
        assert parts.keys() == {*shares, "total"}
        assert parts["total"].item() == pytest.approx(sum(w * parts[k].item() for k, w in shares.items()), rel=1e-5)
    assert PairLoss(network().eval(), LossWeights())(batch).keys() == {*labels, "total"}


@pytest.mark.slow
@pytest.mark.parametrize("kept", ["teacher", "nothing"])
def test_runs_from_before_there_were_such_options_go_on(scenes: list[Sequence], tmp_path: Path, kept: str) -> None:
    chosen, folder = options(4), tmp_path / "run"
    killed = train(network(), scenes[4:], [], folder, chosen, dataclasses.replace(RUN, save_every=2))
    next(killed)
    killed.close()
    state = torch.load(folder / "state.pt", weights_only=True)
    old = json.loads(state["options"])
    if "teacher" in kept:
        del old["teacher"]["teacher_features"]
    else:
        del old["teacher"]
    torch.save({**state, "options": json.dumps(old)}, folder / "state.pt")
    other = dataclasses.replace(chosen, teacher=TeacherOptions("siamfcpp-alexnet"))
    with pytest.raises(UserError, match="other options"):
        list(train(network(), scenes[4:], [], folder, other, RUN))
    assert [row["step"] for row in train(network(), scenes[4:], [], folder, chosen, RUN)] == [4]


def test_teachers_that_are_none_are_refused_before_anything_is_made(scenes: list[Sequence], tmp_path: Path) -> None:
    chosen = dataclasses.replace(options(2), teacher=TeacherOptions("siamfcp-alexnet"))
    with pytest.raises(UserError, match="siamfcp-alexnet"):
        next(train(network(), scenes, [], tmp_path / "run", chosen, RUN))
    assert not (tmp_path / "run").exists()
    for bad in (-1.0, math.nan, math.inf):
        with pytest.raises(UserError, match="teacher-weight"):
            TeacherOptions("x", bad)
        with pytest.raises(UserError, match="teacher-features"):
            TeacherOptions("x", teacher_features=bad)
    with pytest.raises(UserError, match="needs --teacher"):
        TeacherOptions(teacher_features=1.0)


def test_features_of_another_width_are_refused(scenes: list[Sequence], tmp_path: Path) -> None:
    save(tmp_path / "teacher.safetensors", network(9))
    taught = TeacherOptions(str(tmp_path / "teacher.safetensors"), teacher_features=1.0)
    with pytest.raises(UserError, match="6 here, 9 of the teacher"):
        next(train(network(), scenes, [], tmp_path / "run", dataclasses.replace(options(2), teacher=taught), RUN))


@pytest.mark.slow
def test_a_backbone_comes_nearer_to_its_teachers_features(scenes: list[Sequence], tmp_path: Path) -> None:
    path = tmp_path / "teacher.safetensors"
    model = network()
    save(path, model)
    with torch.no_grad():
        model.backbone.conv5.conv.weight.add_(torch.randn_like(model.backbone.conv5.conv.weight) * 0.05)
    plain = PairOptions(search_size=191, augmentation=0.0)
    nothing = LossWeights(cls_weight=0, centerness_weight=0, iou_weight=0)
    chosen = options(100, lr=5e-3, batch=4, pairs=plain, ema=0.0, losses=nothing)
    chosen = dataclasses.replace(chosen, teacher=TeacherOptions(str(path), 0.0, 1.0))
    first, last = train(model, scenes, [], tmp_path / "run", chosen, RUN)
    assert last["features"] < 0.7 * first["features"]

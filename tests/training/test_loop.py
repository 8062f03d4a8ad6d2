"""The loop in this process, on a narrow network; `test_processes` kills and multiplies real ones."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch
from torch import Tensor

from psiamfcpp.datasets import Sequence
from psiamfcpp.datasets.frames import video_frames
from psiamfcpp.errors import UserError
from psiamfcpp.models import SiamFCpp, load
from psiamfcpp.models.checkpoint import read
from psiamfcpp.models.initial import init_neck_and_head
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.spec import ModelSpec
from psiamfcpp.training.batches import Batch
from psiamfcpp.training.loop import PairLoss, train
from psiamfcpp.training.options import LossWeights, PairOptions, RunOptions, Schedule, TrainOptions
from psiamfcpp.training.validation import held_out_batches

ALL_FREE = dict.fromkeys(("conv1", "conv2", "conv3", "conv4", "conv5"), 0.0)
RUN = RunOptions(bf16=False, workers=0, validation_pairs=8)


def network(width: int = 6) -> SiamFCpp:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = SiamFCpp(ModelSpec(widths=dict.fromkeys(ARCHITECTURE.groups, width), search_size=191))
    with torch.no_grad():
        model.backbone.conv1.conv.weight /= 57
    init_neck_and_head(model)
    return model


def options(steps: int, **given: Any) -> TrainOptions:
    schedule = Schedule(steps=steps, lr=given.pop("lr", 1e-3), unfreeze=given.pop("unfreeze", ALL_FREE))
    defaults = {"pairs": PairOptions(search_size=191), "batch": 2, "ema": 0.9}
    return TrainOptions(schedule=schedule, **{**defaults, **given})


Start = Callable[..., Iterator[dict[str, Any]]]


@pytest.fixture
def start(scenes: list[Sequence], tmp_path: Path) -> Start:
    """Starts, or continues, the run in ``tmp_path / "run"``, with a network anew as a new process would."""

    def begin(chosen: TrainOptions, folder: str = "run", model: SiamFCpp | None = None, **run: Any):
        held_out = [s for s in scenes if s.name in ("clip2", "clip3")]
        training = [s for s in scenes if s.name not in ("clip2", "clip3")]
        return train(model or network(), training, held_out, tmp_path / folder, chosen, dataclasses.replace(RUN, **run))

    return begin


def weights(path: Path) -> dict[str, Tensor]:
    return read(path / "model.safetensors")[1]


def rows(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (path / "log.jsonl").read_text().splitlines()]


@pytest.mark.slow
def test_training_lowers_the_loss(scenes: list[Sequence], start: Start, tmp_path: Path):
    plain = dataclasses.replace(PairOptions(search_size=191), augmentation=0.0, negatives=0.1)
    model, batches = network(12), held_out_batches(scenes, plain, 16, 16)

    def cost(network: SiamFCpp) -> dict[str, float]:
        with torch.no_grad():
            return {k: float(v) for k, v in PairLoss(network.train(), LossWeights())(batches[0]).items()}

    before = cost(model)
    list(start(options(20, lr=5e-3, batch=8, pairs=plain, ema=0.0), model=model))
    after = cost(load(tmp_path / "run" / "model.safetensors"))
    assert after["total"] < 0.9 * before["total"]
    assert after["cls"] < before["cls"]
    assert after["iou"] < before["iou"]


@pytest.mark.slow
def test_rows_of_the_log(start: Start, tmp_path: Path):
    yielded = list(start(options(120, batch=1), validate_every=100, validation_pairs=20))
    logged = rows(tmp_path / "run")
    assert logged == yielded
    assert [row["step"] for row in logged] == [50, 100, 120]
    keys = {"step", "lr", "cls", "centerness", "iou", "total", "pairs_per_s"}
    assert set(logged[0]) == keys
    assert set(logged[1]) == set(logged[2]) == {*keys, "validation"}
    assert set(logged[1]["validation"]) == {"within8", "within16", "overlap", "score", "separation"}
    assert logged[0]["lr"] == options(120).schedule.rate(49)
    row = logged[0]
    assert row["total"] == pytest.approx(row["cls"] + row["centerness"] + 3 * row["iou"], rel=1e-5)


@pytest.mark.slow
def test_a_run_killed_and_resumed_ends_alike_to_the_bit(start: Start, tmp_path: Path):
    # conv5 is freed at the step at which the killed run is taken up, conv4 after it.
    chosen = options(6, unfreeze={"conv5": 0.5, "conv4": 0.8, "conv3": 1.0})
    list(start(chosen, folder="straight"))

    killed = start(chosen, save_every=3)
    assert next(killed)["step"] == 6
    killed.close()  # after the last row, before the last state
    state = torch.load(tmp_path / "run" / "state.pt", weights_only=True)
    assert state["step"] == 3

    (row,) = start(chosen, save_every=3)
    assert row["step"] == 6
    straight, resumed = tmp_path / "straight", tmp_path / "run"
    assert (straight / "model.safetensors").read_bytes() == (resumed / "model.safetensors").read_bytes()
    assert [r["step"] for r in rows(resumed)] == [6]
    # The resumed run's row is the mean of its own three steps, but it is validated alike.
    assert rows(resumed)[0]["validation"] == rows(straight)[0]["validation"]


@pytest.mark.slow
def test_saving_more_often_changes_nothing(start: Start, tmp_path: Path):
    list(start(options(4), folder="once"))
    list(start(options(4), folder="often", save_every=1, validate_every=1))
    assert (tmp_path / "once" / "model.safetensors").read_bytes() == (
        tmp_path / "often" / "model.safetensors"
    ).read_bytes()


@pytest.mark.slow
def test_a_finished_run_is_left_as_it_is(start: Start, tmp_path: Path):
    list(start(options(2)))
    before = {p.name: p.read_bytes() for p in (tmp_path / "run").iterdir()}
    assert set(before) == {"model.safetensors", "state.pt", "log.jsonl"}
    assert list(start(options(2))) == []
    assert {p.name: p.read_bytes() for p in (tmp_path / "run").iterdir()} == before


@pytest.mark.slow
@pytest.mark.parametrize("write", ["psiamfcpp.training.loop.torch.save", "psiamfcpp.training.loop.save"])
def test_a_run_killed_between_model_and_state_does_its_last_steps_again(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: str
):
    list(start(options(4), folder="straight"))

    class KilledError(BaseException):
        pass

    def kill(*_: object) -> None:
        raise KilledError

    with monkeypatch.context() as patch:
        patch.setattr(write, kill)
        with pytest.raises(KilledError):
            list(start(options(4)))
    list(start(options(4)))
    assert (tmp_path / "run" / "model.safetensors").read_bytes() == (
        tmp_path / "straight" / "model.safetensors"
    ).read_bytes()


@pytest.mark.slow
def test_log_rows_beyond_the_state_are_dropped(start: Start, tmp_path: Path):
    folder = tmp_path / "run"
    killed = start(options(4), save_every=2)
    next(killed)
    killed.close()
    kept = json.dumps({"step": 2, "cls": 1.0})
    (folder / "log.jsonl").write_text(f'{kept}\n{{"step": 3}}\n5\n\n{{"step": 4, "cl')
    list(start(options(4), save_every=2))
    assert [row["step"] for row in rows(folder)] == [2, 4]


@pytest.mark.slow
def test_other_options_in_the_folder_of_a_run(start: Start):
    list(start(options(2)))
    for other in (
        options(2, lr=2e-3),
        options(3),
        options(2, seed=1),
        options(2, ema=0.5),
        options(2, unfreeze={**ALL_FREE, "conv1": 1.0}),
        options(2, pairs=PairOptions(search_size=191, negatives=0.4)),
    ):
        with pytest.raises(UserError, match=r"state\.pt belongs to a run with other options: use another output"):
            list(start(other))


@pytest.mark.slow
@pytest.mark.parametrize("path", [("clip",), ("losses", "focal_alpha"), ("pairs", "clip_share"), ("losses",)])
def test_a_run_from_before_an_option_was_born_goes_on_with_its_default(
    start: Start, tmp_path: Path, path: tuple[str, ...]
):
    killed = start(options(4), save_every=2)
    next(killed)
    killed.close()
    state = torch.load(tmp_path / "run" / "state.pt", weights_only=True)
    old = json.loads(state["options"])
    *above, last = path
    del (old[above[0]] if above else old)[last]
    torch.save({**state, "options": json.dumps(old)}, tmp_path / "run" / "state.pt")
    with pytest.raises(UserError, match="other options"):
        list(start(options(4, clip=9.0, losses=LossWeights(focal_alpha=0.5), pairs=PairOptions(clip_share=0.1))))
    assert [row["step"] for row in start(options(4))] == [4]


def test_a_schedule_without_a_layer_is_not_filled_up_from_the_default(start: Start):
    list(start(options(2, unfreeze={"conv5": 0.5})))
    assert "conv4" in Schedule(steps=2).unfreeze
    with pytest.raises(UserError, match="other options"):
        list(start(options(2, unfreeze={**Schedule(steps=2).unfreeze, "conv5": 0.5})))


@pytest.mark.slow
def test_losses_leave_the_device_once_per_row_of_the_log(start: Start, monkeypatch: pytest.MonkeyPatch):
    read, reads = torch.Tensor.__float__, []
    monkeypatch.setattr(torch.Tensor, "__float__", lambda tensor: reads.append(tensor) or read(tensor))
    (row,) = start(options(5))
    assert len(reads) == len(row.keys() - {"step", "lr", "pairs_per_s", "validation"})


@pytest.mark.slow
def test_how_a_run_is_carried_out_may_change(start: Start):
    next(start(options(4), save_every=2))
    (row,) = start(options(4), save_every=3, validate_every=7, cache_gb=0.1, validation_pairs=4)
    assert row["step"] == 4


def test_another_network_in_the_folder_of_a_run(start: Start):
    list(start(options(2)))
    with pytest.raises(UserError, match=r"state\.pt belongs to a network of other widths"):
        list(start(options(2), model=network(7)))


@pytest.mark.slow
def test_a_damaged_state_is_named(start: Start, tmp_path: Path):
    list(start(options(2)))
    state = tmp_path / "run" / "state.pt"
    for damaged in (state.read_bytes()[:500], b"junk", b""):
        state.write_bytes(damaged)
        with pytest.raises(UserError, match=r"state\.pt cannot be read") as caught:
            list(start(options(2)))
        assert "\n" not in str(caught.value)


def test_an_output_that_is_a_file(start: Start, tmp_path: Path):
    (tmp_path / "run").write_text("mine")
    with pytest.raises(UserError, match=r"run folder .*run cannot be made"):
        list(start(options(2)))
    assert (tmp_path / "run").read_text() == "mine"


@pytest.mark.slow
@pytest.mark.parametrize(("share", "named"), [(0.0, "log.jsonl"), (0.5, "model.safetensors"), (1.5, "state.pt")])
def test_a_full_disk_is_named_and_the_run_can_go_on(
    start: Start, tmp_path: Path, disk_of: Callable[[int], AbstractContextManager[None]], share: float, named: str
):
    list(start(options(4), folder="straight"))
    wanted = (tmp_path / "straight" / "model.safetensors").read_bytes()
    next(start(options(4), save_every=2))
    with disk_of(int(share * len(wanted))), pytest.raises(UserError, match=f"{named} cannot be written") as caught:
        list(start(options(4), save_every=2))
    assert "\n" not in str(caught.value)
    assert not [path for path in (tmp_path / "run").iterdir() if path.name.endswith(".part")]
    list(start(options(4), save_every=2))
    assert (tmp_path / "run" / "model.safetensors").read_bytes() == wanted


def changed(before: dict[str, Tensor], after: dict[str, Tensor]) -> set[str]:
    return {
        name.rpartition(".conv.")[0]
        for name in before
        if name.endswith("conv.weight") and not torch.equal(before[name], after[name])
    }


@pytest.mark.slow
def test_frozen_layers_stay_and_freed_ones_learn(start: Start, tmp_path: Path):
    before = {name: value.clone() for name, value in network().state_dict().items()}
    schedule = {"conv5": 0.0, "conv4": 0.5, "conv2": 1.0}
    run = start(options(4, unfreeze=schedule, ema=0.0), save_every=2)
    next(run)
    others = {name.rpartition(".conv.")[0] for name in before if "backbone" not in name} - {""}
    assert changed(before, weights(tmp_path / "run")) == {*others, "backbone.conv5"}, "the state of step 2"
    list(run)
    assert changed(before, weights(tmp_path / "run")) == {*others, "backbone.conv5", "backbone.conv4"}


@pytest.mark.slow
def test_the_backbone_keeps_its_statistics_through_validations(start: Start, tmp_path: Path):
    before = {name: value.clone() for name, value in network().named_buffers()}
    list(start(options(55, ema=0.0, batch=1), validate_every=50))
    after = weights(tmp_path / "run")
    for name, value in before.items():
        if name.endswith("running_mean"):
            assert torch.equal(value, after[name]) is name.startswith("backbone."), name


def test_without_a_mean_the_last_weights_are_saved(start: Start, tmp_path: Path):
    model = network()
    list(start(options(3, ema=0.0), model=model))
    saved = weights(tmp_path / "run")
    assert all(torch.equal(value, saved[name]) for name, value in model.state_dict().items())


@pytest.mark.slow
def test_with_a_mean_the_mean_is_saved_and_the_last_weights_go_on(start: Start, tmp_path: Path):
    model = network()
    list(start(options(3, ema=0.9), model=model))
    saved = weights(tmp_path / "run")
    name = "head.cls1.conv.weight"
    assert not torch.equal(saved[name], model.state_dict()[name])
    state = torch.load(tmp_path / "run" / "state.pt", weights_only=True)
    assert torch.equal(state["model"][name], model.state_dict()[name])
    assert torch.equal(state["mean"][name], saved[name])


def test_the_first_steps_hardly_weigh_in_the_mean(start: Start, tmp_path: Path):
    """After one step of a decay of 0.999, the mean has gone nine tenths of the way: its start is no good guess."""
    model = network()
    before = model.state_dict()["head.cls1.conv.weight"].clone()
    list(start(options(1, ema=0.999), model=model))
    after, mean = model.state_dict()["head.cls1.conv.weight"], weights(tmp_path / "run")["head.cls1.conv.weight"]
    torch.testing.assert_close(mean - before, 0.9 * (after - before), rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize("optimizer", ["adamw", "sgd"])
def test_both_optimizers_learn(start: Start, tmp_path: Path, optimizer: str):
    before = network().state_dict()
    list(start(options(2, optimizer=optimizer, ema=0.0)))
    assert "head.cls1" in changed(before, weights(tmp_path / "run"))


def test_without_held_out_clips_nothing_is_validated(scenes: list[Sequence], tmp_path: Path):
    (row,) = train(network(), scenes, [], tmp_path / "run", options(1), RUN)
    assert "validation" not in row


def test_no_usable_box(tmp_path: Path):
    with pytest.raises(UserError, match="no usable box"):
        list(train(network(), [], [], tmp_path / "run", options(1), RUN))


@pytest.mark.slow
def test_a_batch_of_negative_pairs_alone_is_no_trouble(scenes: list[Sequence], start: Start, tmp_path: Path):
    list(start(options(3, pairs=PairOptions(search_size=191, negatives=1.0))))
    assert all(torch.isfinite(value.float()).all() for value in weights(tmp_path / "run").values())


def test_the_loss_is_that_of_the_batch(scenes: list[Sequence]):
    batch: Batch = held_out_batches(scenes, PairOptions(search_size=191), 4, 4)[0]
    module = PairLoss(network().eval(), LossWeights(iou_weight=0.0))
    with torch.no_grad():
        parts = module(batch)
    assert parts["total"].item() == pytest.approx((parts["cls"] + parts["centerness"]).item())


@pytest.mark.slow
def test_low_layers_stand_still_between_their_steps(start: Start, tmp_path: Path):
    chosen = dataclasses.replace(options(3, ema=0.0), schedule=dataclasses.replace(options(3).schedule, low_every=2))
    list(start(chosen))
    ends = []
    for _ in range(3):
        list(start(chosen, folder="stepwise", max_time=1e-9))
        ends.append(weights(tmp_path / "stepwise"))
    for name, moves in (("backbone.conv1.conv.weight", [False, True]), ("backbone.conv3.conv.weight", [True, True])):
        assert [not torch.equal(ends[k][name], ends[k + 1][name]) for k in (0, 1)] == moves
    assert all(torch.equal(value, ends[2][name]) for name, value in weights(tmp_path / "run").items())


@pytest.mark.slow
def test_a_run_ends_when_its_time_is_over_and_can_be_continued(start: Start, tmp_path: Path):
    (row,) = start(options(4), max_time=1e-9)
    assert row["step"] == 1
    assert torch.load(tmp_path / "run" / "state.pt", weights_only=True)["step"] == 1
    list(start(options(4)))
    list(start(options(4), folder="straight"))
    first, second = (weights(tmp_path / name) for name in ("run", "straight"))
    assert all(torch.equal(value, second[name]) for name, value in first.items())


@pytest.mark.slow
def test_a_run_goes_on_from_weights_and_step_alone(start: Start, tmp_path: Path):
    """The pairs and the rate are those of the step; only what the optimizer remembers is new."""
    chosen = options(6, optimizer="sgd", ema=0.0)
    list(start(chosen, save_every=1, max_time=1e-9))
    (row,) = start(chosen, folder="on", model=load(tmp_path / "run" / "model.safetensors"), first_step=1)
    assert row["step"] == 6
    list(start(chosen))
    on, whole = weights(tmp_path / "on"), weights(tmp_path / "run")
    apart = max(float((on[k] - whole[k]).abs().max() / (whole[k].abs().max() + 1e-9)) for k in on if on[k].ndim == 4)
    assert 0 < apart < 0.05


@pytest.mark.slow
def test_frames_of_videos_are_kept_in_the_runs_folder(scenes: list[Sequence], tmp_path: Path):
    path = tmp_path / "clip.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25, (200, 160))
    for k in range(6):
        writer.write(scenes[0].frame(k))
    writer.release()
    clip = dataclasses.replace(scenes[0], frames=video_frames(path))
    list(train(network(), [clip], [clip], tmp_path / "run", options(1), RUN))
    assert len(list((tmp_path / "run" / "frames").glob("clip-*/*.jpg"))) == 6
    list(
        train(
            network(), [clip], [], tmp_path / "other", options(1), dataclasses.replace(RUN, frames=str(tmp_path / "f"))
        )
    )
    assert len(list((tmp_path / "f").glob("clip-*/*.jpg"))) == 6


@pytest.mark.slow
def test_compiled_it_learns_the_same(start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With layers that are free on every other step: each part is compiled once, and not anew at each."""
    compiled = []

    def without_a_compiler(module: torch.nn.Module) -> None:
        compiled.append(type(module).__name__)
        own(module, backend="eager")

    own = torch.nn.Module.compile
    monkeypatch.setattr(torch.nn.Module, "compile", without_a_compiler)
    chosen = options(3, ema=0.0)
    chosen = dataclasses.replace(chosen, schedule=dataclasses.replace(chosen.schedule, low_every=2))
    list(start(chosen, folder="compiled", compile=True))
    assert compiled == ["Backbone", "Part", "Head"]
    list(start(chosen, folder="plain"))
    first, second = (weights(tmp_path / name) for name in ("compiled", "plain"))
    assert all(torch.allclose(value, second[name], rtol=1e-3, atol=1e-4) for name, value in first.items())

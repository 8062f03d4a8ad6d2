from __future__ import annotations

import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.training.options import RunOptions, Schedule


@pytest.mark.parametrize(
    ("step", "rate"),
    [
        (0, 0.2),  # the first of ten warm-up steps is not lost at a rate of 0
        (4, 1.0),
        (9, 2.0),
        (10, 2.0),
        (40, 0.2 + 1.8 * (1 + 0.5) / 2),  # a third of the cosine
        (55, 0.2 + 1.8 / 2),
        (70, 0.2 + 1.8 * (1 - 0.5) / 2),
        (100, 0.2),
    ],
)
def test_rate(step: int, rate: float):
    assert Schedule(steps=100, lr=2.0, warmup=0.1, final_lr=0.1).rate(step) == pytest.approx(rate)


@pytest.mark.parametrize(("steps", "warmup"), [(1, 0.0), (1, 1.0), (7, 0.0), (20, 1.0), (50, 0.33)])
def test_rate_rises_to_the_highest_and_then_falls(steps: int, warmup: float):
    rates = [Schedule(steps=steps, lr=1.0, warmup=warmup).rate(step) for step in range(steps)]
    top = rates.index(max(rates))
    assert max(rates) == pytest.approx(1.0)
    assert rates[: top + 1] == sorted(rates[: top + 1])
    assert rates[top:] == sorted(rates[top:], reverse=True)
    assert min(rates) > 0


@pytest.mark.parametrize(
    ("step", "layers"),
    [
        (0, {"conv1"}),
        (24, {"conv1"}),
        (25, {"conv1", "conv5"}),
        (49, {"conv1", "conv5"}),
        (50, {"conv1", "conv4", "conv5"}),
        (99, {"conv1", "conv4", "conv5"}),
    ],
)
def test_layers_are_freed_at_their_share(step: int, layers: set[str]):
    schedule = Schedule(steps=100, unfreeze={"conv1": 0.0, "conv5": 0.25, "conv4": 0.5, "conv2": 1.0})
    assert schedule.free(step) == layers


def test_by_default_the_first_two_layers_are_never_freed():
    schedule = Schedule(steps=1000)
    assert schedule.free(0) == frozenset()
    assert schedule.free(999) == {"conv3", "conv4", "conv5"}


@pytest.mark.parametrize("unfreeze", [{"conv6": 0.5}, {"conv5": 1.5}, {"conv5": -0.1}, {"conv5": float("nan")}])
def test_unfreeze_names_what_is_wrong(unfreeze: dict[str, float]):
    with pytest.raises(UserError, match=rf"unfreeze {next(iter(unfreeze))}=.*conv1, conv2.*0\.\.1"):
        Schedule(unfreeze=unfreeze)


@pytest.mark.parametrize("values", [{"steps": 0}, {"steps": -5}, {"lr": 0.0}, {"lr": -1e-3}])
def test_steps_and_rate_are_above_zero(values):
    with pytest.raises(UserError, match="must be above 0"):
        Schedule(**values)


@pytest.mark.parametrize(
    ("step", "layers"), [(0, {"conv1", "conv5"}), (1, {"conv5"}), (2, {"conv5"}), (3, {"conv1", "conv5"})]
)
def test_low_layers_on_one_step_in_so_many(step: int, layers: set[str]):
    assert Schedule(unfreeze={"conv1": 0.0, "conv5": 0.0}, low_every=3).free(step) == layers


def test_low_layers_at_least_on_every_step():
    with pytest.raises(UserError, match="low-every is 0"):
        Schedule(low_every=0)


@pytest.mark.parametrize("minutes", [0.0, -1.0, float("nan")])
def test_max_time_is_above_zero(minutes: float):
    with pytest.raises(UserError, match="max-time"):
        RunOptions(max_time=minutes)

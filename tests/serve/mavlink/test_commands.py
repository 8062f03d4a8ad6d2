"""Commands are carried out one by one, and repeats of a command are answered instead of carried out."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

pytest.importorskip("pymavlink", reason="pymavlink is not installed")

from pymavlink.dialects.v20 import common as mav

from psiamfcpp.serve.mavlink.commands import Commands

TIMEOUT_S = 300.0


class Worker:
    """Work that waits until the test lets it end, so that no result depends on how fast the machine is."""

    def __init__(self, result: int) -> None:
        self.result, self.calls = result, 0
        self.may_end, self.answered = threading.Event(), threading.Event()
        self.answers: list[int] = []

    def work(self) -> int:
        self.calls += 1
        assert self.may_end.wait(TIMEOUT_S)
        return self.result

    def answer(self, result: int) -> None:
        self.answers.append(result)
        if result == self.result:
            self.answered.set()


@pytest.fixture
def commands() -> Iterator[Commands]:
    failures: list[Exception] = []
    with Commands(failures.append, clock=lambda: 0.0) as running:
        yield running
    assert not failures


def test_repeats_of_a_running_command_are_in_progress_and_many_are_rejected(commands: Commands) -> None:
    worker = Worker(mav.MAV_RESULT_DENIED)
    for _ in range(50):
        commands.give("a station", "track", False, worker.work, worker.answer)
    in_progress = worker.answers.count(mav.MAV_RESULT_IN_PROGRESS)
    assert 0 < in_progress < 49
    assert worker.answers == [mav.MAV_RESULT_IN_PROGRESS] * in_progress + [mav.MAV_RESULT_TEMPORARILY_REJECTED] * (
        49 - in_progress
    )
    worker.may_end.set()
    assert worker.answered.wait(TIMEOUT_S)
    assert worker.answers[-1] == mav.MAV_RESULT_DENIED
    assert worker.calls == 1


@pytest.mark.parametrize(("result", "calls"), [(mav.MAV_RESULT_ACCEPTED, 1), (mav.MAV_RESULT_DENIED, 2)])
def test_only_what_was_accepted_is_not_carried_out_again(commands: Commands, result: int, calls: int) -> None:
    worker = Worker(result)
    worker.may_end.set()
    for _ in range(2):
        worker.answered.clear()
        commands.give("a station", "track", False, worker.work, worker.answer)
        assert worker.answered.wait(TIMEOUT_S)
    assert worker.answers == [result, result]
    assert worker.calls == calls


def test_other_commands_of_one_station_wait_in_a_short_queue(commands: Commands) -> None:
    worker = Worker(mav.MAV_RESULT_ACCEPTED)
    for number in range(10):
        commands.give("a station", number, False, worker.work, worker.answer)
    waiting = 10 - worker.answers.count(mav.MAV_RESULT_TEMPORARILY_REJECTED)
    assert 0 < waiting < 10
    other = Worker(mav.MAV_RESULT_ACCEPTED)
    other.may_end.set()
    commands.give("another station", 0, False, other.work, other.answer)
    assert other.answers == []
    worker.may_end.set()
    assert other.answered.wait(TIMEOUT_S)
    assert worker.calls == waiting

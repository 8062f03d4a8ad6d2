"""Reading ahead and writing behind: order, errors, and what an interruption leaves."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.video.threads import ahead, behind

TIMEOUT_S = 60.0


def broken(count: int) -> Iterator[int]:
    yield from range(count)
    raise UserError("cut off")


@pytest.mark.parametrize("count", [0, 1, 3, 50])
def test_items_come_in_their_order(count: int) -> None:
    with ahead(iter(range(count))) as items:
        assert list(items) == list(range(count))


def test_an_error_of_reading_comes_after_what_was_read() -> None:
    found = []
    with ahead(broken(10)) as items, pytest.raises(UserError, match="cut off"):
        for item in items:
            found.append(item)
    assert found == list(range(10))


def test_reading_overlaps_but_only_a_few_items() -> None:
    read, enough = [], threading.Event()

    def source() -> Iterator[int]:
        for item in range(100):
            read.append(item)
            if len(read) == 3:
                enough.set()
            yield item

    with ahead(source()) as items:
        assert next(items) == 0
        # items that nobody asked for yet
        assert enough.wait(TIMEOUT_S)
    assert len(read) < 20


def test_calls_are_carried_out_in_order_and_before_the_block_ends() -> None:
    done: list[int] = []
    with behind(done.append) as call:
        for number in range(50):
            call(number)
    assert done == list(range(50))


def test_calls_overlap_with_the_caller() -> None:
    may_go, done = threading.Event(), []

    def work(number: int) -> None:
        assert may_go.wait(TIMEOUT_S)
        done.append(number)

    with behind(work) as call:
        call(0)
        assert done == []
        may_go.set()
    assert done == [0]


def test_an_error_of_a_call_is_raised_and_ends_the_work() -> None:
    done: list[int] = []

    def work(number: int) -> None:
        if number == 3:
            raise UserError("disk full")
        done.append(number)

    with pytest.raises(UserError, match="disk full"), behind(work) as call:
        for number in range(50):
            call(number)
    assert done == [0, 1, 2]


def test_what_was_handed_over_is_done_after_an_interruption() -> None:
    done: list[int] = []
    with pytest.raises(KeyboardInterrupt), behind(done.append) as call:
        for number in range(10):
            call(number)
        raise KeyboardInterrupt
    assert done == list(range(10))

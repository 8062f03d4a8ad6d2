"""Token buckets: what is allowed, by whom."""

from __future__ import annotations

from psiamfcpp.serve.limits import Bucket, Buckets

from .conftest import Clock


def test_a_bucket_allows_a_burst_and_then_its_rate() -> None:
    clock = Clock()
    bucket = Bucket(2.0, 3.0, clock)
    assert [bucket.take() for _ in range(5)] == [True, True, True, False, False]
    assert bucket.empty()
    clock.now += 0.5
    assert not bucket.empty()
    assert [bucket.take() for _ in range(2)] == [True, False]
    clock.now += 1000
    assert [bucket.take() for _ in range(4)] == [True, True, True, False]


def test_one_sender_does_not_use_up_what_is_meant_for_another() -> None:
    buckets = Buckets(1.0, 2.0, Clock())
    assert [buckets.take("a") for _ in range(4)] == [True, True, False, False]
    assert [buckets.take("b") for _ in range(3)] == [True, True, False]
    assert buckets.empty("a")


def test_memory_is_bounded_and_the_last_heard_stay() -> None:
    buckets = Buckets(1.0, 1.0, Clock())
    for number in range(5000):
        buckets.take("steady")
        buckets.take(number)
    assert len(buckets._buckets) <= 1024
    assert not buckets.take("steady")

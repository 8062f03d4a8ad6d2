"""Signals that end a command as Ctrl-C does."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from psiamfcpp.signals import ended_like_ctrl_c

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no such signals")


@pytest.fixture(autouse=True)
def _as_in_a_foreground_shell() -> Iterator[None]:
    """A test run started by nohup or in the background has signals ignored, which would stay so."""
    kinds = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [
        signal.signal(kind, signal.default_int_handler if kind == signal.SIGINT else signal.SIG_DFL) for kind in kinds
    ]
    yield
    for kind, handler in zip(kinds, before, strict=True):
        signal.signal(kind, handler)


def send(kind: int) -> None:
    os.kill(os.getpid(), kind)
    signal.getsignal(kind)  # handlers run between two instructions


@pytest.mark.parametrize("kind", ["SIGTERM", "SIGHUP"])
def test_a_signal_interrupts_once_and_is_restored(kind: str) -> None:
    number = getattr(signal, kind)
    cleaned = False
    with pytest.raises(KeyboardInterrupt), ended_like_ctrl_c():
        try:
            send(number)
            pytest.fail("it was not interrupted")
        finally:
            send(number)  # the same wish again: cleaning goes on
            cleaned = True
    assert cleaned
    assert signal.getsignal(number) is signal.SIG_DFL


def test_what_is_ignored_or_handled_stays_so() -> None:
    seen: list[int] = []
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN), signal.signal(signal.SIGTERM, lambda n, _: seen.append(n))
    try:
        with ended_like_ctrl_c():
            send(signal.SIGHUP)
            send(signal.SIGTERM)
        assert seen == [signal.SIGTERM]
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before[0])
        signal.signal(signal.SIGTERM, before[1])


def test_other_threads_and_forks_are_left_alone() -> None:
    entered: list[object] = []

    def within() -> None:
        with ended_like_ctrl_c():
            entered.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=within)
    thread.start()
    thread.join()
    assert entered == [signal.SIG_DFL]
    with ended_like_ctrl_c():
        child = os.fork()
        if not child:
            send(signal.SIGTERM)
            os._exit(3)
        _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == -signal.SIGTERM


@pytest.mark.parametrize("kind", ["SIGINT", "SIGTERM"])
def test_what_comes_during_an_import_waits_for_its_end(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (
        f"import os, signal, time\nos.kill(os.getpid(), signal.{kind})\nfor _ in range(9): time.sleep(0.02)\ndone = 1"
    )
    name = f"imported_{kind.lower()}"
    (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(KeyboardInterrupt), ended_like_ctrl_c() as ending:
        importlib.import_module(name)
        time.sleep(60)
    assert ending.asked
    assert sys.modules[name].done == 1
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGALRM) is signal.SIG_DFL


def test_without_a_signal_nobody_asked() -> None:
    with ended_like_ctrl_c() as ending:
        pass
    assert not ending.asked

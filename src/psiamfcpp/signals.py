"""What a service manager, a shutdown or a closed terminal sends ends a command as Ctrl-C does."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")
# Whoever sends the signal again meanwhile asks for the same end; the files of the first are being finished.
_SAME_S = 5.0
# While a module is imported, so long until it is looked at again.
_IMPORT_S = 0.05


@dataclass
class Ending:
    """Whether a signal has asked for the end."""

    asked: bool = False


@contextmanager
def ended_like_ctrl_c() -> Iterator[Ending]:
    """Turn SIGTERM and SIGHUP into `KeyboardInterrupt`, in a ``with`` block or a decorated function.

    So ``finally`` and ``with`` blocks run, and files are finished. A signal that is ignored (``nohup``) or handled
    already stays so. While a module is imported, the interruption waits for the end of that: libraries swallow it
    there, or end with a traceback of their own. Does nothing outside of the main thread, where Python handles no
    signals.

    Yields:
        An object that says whether there was a signal: some libraries make another error of the interruption.
    """
    ending = Ending()
    if threading.current_thread() is not threading.main_thread():
        yield ending
        return
    process, last = os.getpid(), -_SAME_S

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal last
        if os.getpid() != process:
            # a fork of ours: whoever ends it wants no traceback from it
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        now = time.monotonic()
        if number == signal.SIGINT or now - last >= _SAME_S:
            last, ending.asked = now, True
            end(number, frame)

    def end(number: int, frame: FrameType | None) -> None:
        if hasattr(signal, "setitimer") and _is_importing(frame):
            signal.setitimer(signal.ITIMER_REAL, _IMPORT_S)
            return
        raise KeyboardInterrupt

    own = (signal.SIG_DFL, signal.default_int_handler)
    kinds = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
    handlers = {kind: signal.getsignal(kind) for kind in kinds}
    changed = {kind: handler for kind, handler in handlers.items() if handler in own}
    for kind in changed:
        signal.signal(kind, interrupt)
    if hasattr(signal, "SIGALRM") and signal.getsignal(signal.SIGALRM) is signal.SIG_DFL:
        changed[signal.SIGALRM] = signal.SIG_DFL
        signal.signal(signal.SIGALRM, end)
    try:
        yield ending
    finally:
        if signal.SIGALRM in changed:
            signal.setitimer(signal.ITIMER_REAL, 0)
        for kind, handler in changed.items():
            signal.signal(kind, handler)


def ignore_signals() -> None:
    """Let nothing but SIGKILL end the process any more."""
    for name in _NAMES:
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False

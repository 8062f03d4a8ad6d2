"""What a service manager, a shutdown or a closed terminal sends ends a command as Ctrl-C does."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_NAMES = ("SIGTERM", "SIGHUP")
# Whoever sends the signal again meanwhile asks for the same end; the files of the first are being finished.
_SAME_S = 5.0


@contextmanager
def ended_like_ctrl_c() -> Iterator[None]:
    """Turn SIGTERM and SIGHUP into `KeyboardInterrupt`, in a ``with`` block or a decorated function.

    So ``finally`` and ``with`` blocks run, and files are finished. A signal that is ignored (``nohup``) or handled
    already stays so. Does nothing outside of the main thread, where Python handles no signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    process, last = os.getpid(), -_SAME_S

    def interrupt(number: int, _: FrameType | None) -> None:
        nonlocal last
        if os.getpid() != process:
            # a fork of ours: whoever ends it wants no traceback from it
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        now = time.monotonic()
        if now - last >= _SAME_S:
            last = now
            raise KeyboardInterrupt

    kinds = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
    changed = [kind for kind in kinds if signal.getsignal(kind) is signal.SIG_DFL]
    for kind in changed:
        signal.signal(kind, interrupt)
    try:
        yield
    finally:
        for kind in changed:
            signal.signal(kind, signal.SIG_DFL)

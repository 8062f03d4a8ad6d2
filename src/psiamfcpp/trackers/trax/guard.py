"""A process between us and a worker, so that nothing of the worker outlives either of them.

Run as ``python -I -S guard.py CONTROL FOLDER COMMAND...``. CONTROL is the descriptor of a pipe that only our process
holds open for writing: when it closes, by `close` or because we were killed, the guard kills the worker and all of
its descendants, removes FOLDER and ends. It ends in the same way after the worker, and with its exit status; a signal
N gives 128 + N, as in a shell.

On Linux the guard adopts what the worker leaves behind (``PR_SET_CHILD_SUBREAPER``, prctl(2)), so that a worker that
forks into a new session is found as well. Elsewhere it kills the worker's process group.
"""

from __future__ import annotations

import ctypes
import os
import select
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from contextlib import suppress
from pathlib import Path

_CHILD_SUBREAPER = 36
# seconds
_DESPERATE = 30.0


def main(control: int, folder: str, command: list[str]) -> int:
    """Run a command until it ends or the control pipe closes; see the module."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_CHILD_SUBREAPER, 1, 0, 0, 0)
    try:
        worker = subprocess.Popen(command, start_new_session=True, preexec_fn=_interruptible)
    except OSError as error:
        print(f"cannot be started: {error.strerror}", file=sys.stderr)
        return 127
    # The worker's streams must close when it ends, so no copy of them may stay here.
    nothing = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):
        os.dup2(nothing, descriptor)
    threading.Thread(target=_watch, args=(control, worker.pid, folder, os.getppid()), daemon=True).start()
    status = worker.wait()
    _kill_all(worker.pid)
    shutil.rmtree(folder, ignore_errors=True)
    return status if status >= 0 else 128 - status


def _interruptible() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _watch(control: int, worker: int, folder: str, parent: int) -> None:
    # A copy of the pipe in a fork of our process would keep it open: the parent itself is watched too.
    while os.getppid() == parent and not select.select([control], [], [], 1.0)[0]:
        continue
    _kill_all(worker)
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(128 + signal.SIGKILL)


def _kill_all(worker: int) -> None:
    """Kill all descendants; a worker that forks faster than it is killed is stopped first.

    A look at /proc can miss a process that is forked meanwhile. But orphans become children of the guard, so that
    there are none left when it has no child.
    """
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(worker, signal.SIGKILL)
    end = time.monotonic() + _DESPERATE
    while _has_children() and time.monotonic() < end:
        alive = _descendants(os.getpid())
        for sign in (signal.SIGSTOP, signal.SIGKILL):
            for process in alive:
                with suppress(ProcessLookupError, PermissionError):
                    os.kill(process, sign)
        time.sleep(0.01)


def _has_children() -> bool:
    """Reap all children that are dead, and say whether others are left."""
    try:
        while os.waitpid(-1, os.WNOHANG)[0]:
            continue
    except ChildProcessError:
        return False
    return True


def _descendants(root: int) -> list[int]:
    """Return all processes below one that are not dead yet; none where there is no /proc."""
    children: dict[int, list[int]] = defaultdict(list)
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, ValueError, IndexError):
            # "pid (name) state parent ...", and a name may hold anything
            state, parent = (folder / "stat").read_text(errors="replace").rpartition(")")[2].split()[:2]
            children[int(parent)].append(int(folder.name))
            if state == "Z":
                children[-1].append(int(folder.name))
    found: list[int] = []
    waiting = [root]
    while waiting:
        below = children.get(waiting.pop(), [])
        found += below
        waiting += below
    return sorted(set(found) - set(children[-1]))


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), sys.argv[2], sys.argv[3:]))

"""`adapter:NAME,...`: a published deep tracker, run by its own code in its own interpreter.

Each file of ``psiamfcpp/trackers/adapters`` that states ``FACTS`` is an adapter: a TraX worker that the tracker's
interpreter runs. Here they are read as text, never imported.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from psiamfcpp.errors import UserError
from psiamfcpp.runtime import usable_cores
from psiamfcpp.trackers.trax.client import FRAME_SECONDS, START_SECONDS, TraxTracker

RANDOM = "random"
"""what to give for weights to try an installation: the boxes mean nothing"""
_FOLDER = Path(__file__).resolve().parents[1] / "adapters"
# Options of ours; all others go to the adapter.
_OURS = ("checkout", "weights", "python", "device", "timeout")
_PROBE_SECONDS = 60


def open_adapter(name: str, options: Mapping[str, str], threads: int | None = None) -> TraxTracker:
    """Start the worker of a published tracker.

    Args:
        name: such as transt; `adapters` has all.
        options: ``checkout``, the folder of the tracker's repository; ``weights``, its file, or random to try the
            installation; ``python``, the interpreter with what the tracker needs, by default ours; ``device``, cpu
            (the default) or cuda; ``timeout``, seconds for one frame; and what the adapter itself knows.
        threads: threads of the tracker; by default all that this process may use.

    Raises:
        UserError: unknown name, a missing option or file, or a worker that cannot start.
    """
    what = identity(name, options)
    script, facts, device = _script(name), adapters()[name], what["device"]
    python = options.get("python", sys.executable)
    if shutil.which(python) is None:
        raise UserError(f"python {python} of adapter:{name} does not exist: give the interpreter of {facts['name']}")
    count = str(threads or usable_cores())
    command = [python, str(script), "--checkout", options["checkout"], "--device", device, "--threads", count]
    if options["weights"] != RANDOM:
        command += ["--weights", options["weights"]]
    for key, value in _own(options).items():
        command += ["--set", f"{key}={Path(value).resolve() if Path(value).is_file() else value}"]
    return TraxTracker(
        command,
        name,
        what,
        label=f"adapter:{name}",
        environment={"OMP_NUM_THREADS": count, "MKL_NUM_THREADS": count},
        frame_seconds=_seconds(name, options),
        start_seconds=START_SECONDS,
        reuse=True,
    )


def identity(name: str, options: Mapping[str, str]) -> dict[str, Any]:
    """Return the identity of ``adapter:NAME,...`` without starting it.

    Raises:
        UserError: unknown name, or a missing option or file.
    """
    files = adapter_files(name, options)
    device = options.get("device", "cpu")
    if device not in ("cpu", "cuda"):
        raise UserError(f"device {device!r} of adapter:{name} is unknown: give cpu or cuda")
    shown = {key: Path(value).name if Path(value).is_file() else value for key, value in sorted(_own(options).items())}
    return {
        "kind": "adapter",
        "tracker": name,
        "commit": adapters()[name]["commit"],
        "device": device,
        "options": shown,
        "checksum": _checksum([_script(name), *_helpers(), *files]),
    }


def open_tracker(name: str, options: Mapping[str, str]) -> TraxTracker:
    """Open ``adapter:NAME,...``; takes ``threads`` among the options."""
    others = {key: value for key, value in options.items() if key != "threads"}
    return open_adapter(name, others, int(options["threads"]) if "threads" in options else None)


def adapter_files(name: str, options: Mapping[str, str]) -> list[Path]:
    """Return the model files of an adapter, whose content is part of the tracker's identity.

    Raises:
        UserError: unknown name, or a missing option, folder or file.
    """
    facts = adapters()[name] if name in adapters() else _unknown(name)
    for key, what in (("checkout", f"a copy of {facts['repository']}"), ("weights", facts["weights"])):
        if not options.get(key):
            raise UserError(f"adapter:{name} needs {key}, {what}: give adapter:{name},checkout=DIR,weights=FILE")
    if not Path(options["checkout"]).is_dir():
        raise UserError(f"checkout {options['checkout']} of adapter:{name} is no folder: clone {facts['repository']}")
    if options["weights"] == RANDOM:
        files = []
    elif Path(options["weights"]).is_file():
        files = [Path(options["weights"])]
    else:
        raise UserError(f"weights {options['weights']} of adapter:{name} do not exist: fetch {facts['weights']}")
    return files + [Path(value) for value in _own(options).values() if Path(value).is_file()]


@cache
def adapters() -> dict[str, dict[str, Any]]:
    """Return what each adapter states of its tracker, by name.

    Keys are name, repository, commit (that it was written for), licence, weights, modules (that the interpreter
    needs), colour, origin (0 or 1, where the tracker counts pixels from), notes.
    """
    found = {}
    for path in sorted(_FOLDER.glob("*.py")):
        for node in ast.parse(path.read_text("utf-8")).body:
            if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["FACTS"]:
                found[path.stem] = ast.literal_eval(node.value)
    return found


def describe_adapters(options: Mapping[str, Mapping[str, str]] | None = None) -> list[dict[str, Any]]:
    """Return all adapters with what is missing to run each.

    Args:
        options: checkout, weights and python by adapter, as far as they are known.

    Returns:
        The facts of `adapters`, with ``adapter``, its name, and ``missing``, a list of sentences.
    """
    given = options or {}
    return [
        {"adapter": name, **facts, "missing": _missing(facts, given.get(name, {}))}
        for name, facts in adapters().items()
    ]


def _missing(facts: Mapping[str, Any], options: Mapping[str, str]) -> list[str]:
    missing = []
    if not Path(options.get("checkout") or "/nowhere").is_dir():
        missing.append(f"checkout: git clone {facts['repository']}; git checkout {facts['commit'][:10]}")
    weights = options.get("weights", "")
    if weights != RANDOM and not Path(weights or "/nowhere").is_file():
        missing.append(f"weights: {facts['weights']}")
    absent = _absent_modules(options.get("python", sys.executable), tuple(facts["modules"]))
    if absent:
        missing.append("modules: " + ", ".join(absent))
    return missing


@cache
def _absent_modules(python: str, modules: tuple[str, ...]) -> list[str]:
    """Return the modules that an interpreter lacks; all of them where it cannot be asked."""
    if python == sys.executable:
        return [name for name in modules if importlib.util.find_spec(name) is None]
    code = "import importlib.util as u, sys; print(*[m for m in sys.argv[1:] if u.find_spec(m) is None])"
    try:
        asked = [python, "-c", code, *modules]
        done = subprocess.run(asked, capture_output=True, text=True, timeout=_PROBE_SECONDS, check=True)
    except (OSError, subprocess.SubprocessError):
        return list(modules)
    return done.stdout.split()


def _own(options: Mapping[str, str]) -> dict[str, str]:
    """Return the options that go to the adapter."""
    return {key: value for key, value in options.items() if key not in _OURS}


def _script(name: str) -> Path:
    if name not in adapters():
        _unknown(name)
    return _FOLDER / f"{name}.py"


def _helpers() -> list[Path]:
    """Return what the adapters share, which decides their boxes as well."""
    return [path for path in sorted(_FOLDER.glob("*.py")) if path.stem not in adapters()]


def _unknown(name: str) -> Any:
    raise UserError(f"unknown adapter {name!r}: there are {', '.join(adapters())}")


def _seconds(name: str, options: Mapping[str, str]) -> float:
    text = options.get("timeout", str(FRAME_SECONDS))
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < float("inf"):
        raise UserError(f"timeout {text!r} of adapter:{name} is no number of seconds above 0")
    return seconds


def _checksum(files: list[Path]) -> str:
    found = hashlib.sha256()
    for file in files:
        found.update(hashlib.sha256(file.read_bytes()).digest())
    return found.hexdigest()[:16]

"""Checksums of model files, by which runs distinguish trackers of the same name."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any


def checksum(files: Iterable[Path]) -> str:
    """Return a checksum of 16 hexadecimal digits over the files' content in their order; empty without files.

    Raises:
        OSError: a file cannot be read.
    """
    found, count = hashlib.sha256(), 0
    for path in files:
        found.update(path.read_bytes())
        count += 1
    return found.hexdigest()[:16] if count else ""


def tracker_identity(entry: str, options: Mapping[str, str], code: Iterable[Path] = ()) -> dict[str, Any]:
    """Return the identity of a tracker that is no model of ours (see `psiamfcpp.trackers.contract.Tracker`).

    Args:
        entry: kind and name.
        options: as given; those that name a file count by its content.
        code: files that the tracker is written in, where they are the user's own.
    """
    files = {key: Path(value) for key, value in options.items() if Path(value).is_file()}
    try:
        found = checksum([*files.values(), *code])
    except OSError:
        found = ""
    return {"entry": entry, "checksum": found, **{k: v for k, v in options.items() if k not in files}}

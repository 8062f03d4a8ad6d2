"""What was recorded, for clients to fetch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

_FILES = ("video.mkv", "boxes.csv")
_MOST = 200


def listed(folder: Path) -> list[dict[str, Any]]:
    """Return the recordings of a folder, newest first, as `psiamfcpp.serve.messages.Recording`.

    One that still runs is not among them: its video gets its name at the end.
    """
    found = []
    for each in sorted(_folders(folder), reverse=True)[:_MOST]:
        files = [{"name": name, "bytes": (each / name).stat().st_size} for name in _FILES if (each / name).is_file()]
        if any(file["name"] == "video.mkv" for file in files):
            found.append({"name": each.name, "files": files})
    return found


def find(folder: Path, name: str, file: str) -> Path | None:
    """Return the path of a file of a recording, or None where there is none; no name leads out of the folder."""
    if file not in _FILES:
        return None
    path = next((each / file for each in _folders(folder) if each.name == name), None)
    return path if path is not None and path.is_file() else None


def _folders(folder: Path) -> list[Path]:
    try:
        return [each for each in folder.iterdir() if each.is_dir() and not each.is_symlink()]
    except OSError:
        return []

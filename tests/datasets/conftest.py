"""Miniature datasets, written file by file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

Lay = Callable[..., Path]


@pytest.fixture
def lay(tmp_path: Path) -> Lay:
    """Writes text files below a root, and empty ones where a reader needs the name alone (images)."""

    def write(texts: dict[str, str], empty: tuple[str, ...] = ()) -> Path:
        root = tmp_path / "data"
        root.mkdir(exist_ok=True)
        for name, text in {**dict.fromkeys(empty, ""), **texts}.items():
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return root

    return write

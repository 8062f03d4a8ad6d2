"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import os
import threading
from pathlib import Path

from psiamfcpp.errors import UserError


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file under a temporary name and rename it; its folder is made if need be.

    Raises:
        UserError: it cannot be written.
    """
    # two processes that were given the same work must not write into one another's file
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            # else a machine that loses power keeps the name without the content
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise UserError(f"{path} cannot be written ({error.strerror or error}): free or change the place") from None

"""Write files completely or not at all."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path

from psiamfcpp.errors import UserError


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Give a temporary path to write to; it becomes ``path`` at the end of the block.

    The parent folder is made. After any error, Ctrl-C included, an older file is as it was and nothing else is left.
    The mode of the file is the one that the umask gives, whatever the writer makes of it.

    Args:
        path: the file to write.

    Yields:
        An empty file in the folder of ``path``.

    Raises:
        UserError: the file cannot be written.
    """
    # Two processes that were given the same work must not write to the same temporary file.
    temporary = path.parent / f".{path.name}.{os.getpid()}.{threading.get_ident()}.part"
    with writing(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.touch()
            mode = temporary.stat().st_mode
            yield temporary
            # safetensors writes 0600, which keeps a service of another user from reading a model.
            temporary.chmod(mode)
            with temporary.open("rb+") as file:
                # Otherwise a machine that loses power keeps the name without the content.
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise


def write_whole(path: Path, content: str | bytes | memoryview) -> None:
    """Write a file as by `whole`; text is written as UTF-8, with its line ends as they are.

    Raises:
        UserError: the file cannot be written.
    """
    with whole(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an ``OSError`` of the block into a `UserError` that names ``path``."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(f"{path} cannot be written ({reason}): free disk space or choose another place") from None

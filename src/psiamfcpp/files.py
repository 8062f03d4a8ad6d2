"""Write files completely or not at all."""

from __future__ import annotations

import contextlib
import glob
import os
import threading
from collections.abc import Iterable, Iterator
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


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[str | Path | None]) -> None:
    """Refuse outputs that would overwrite an input or each other, links included; None and missing files are fine.

    Args:
        outputs: files to be written.
        inputs: files, or folders and globs of files; anything that names no file is passed over.

    Raises:
        UserError: names the output and what it would overwrite.
    """
    read = {same: name for name in inputs if name is not None for same in _identities(name)}
    written: dict[object, Path] = {}
    for path in (path for path in outputs if path is not None):
        for same in _identities(path) or {path.absolute()}:
            if same in read:
                raise UserError(f"output {path} is the input {read[same]}: choose another name")
            if same in written:
                raise UserError(f"output {path} is named twice: choose another name for one of them")
            written[same] = path


def _identities(name: str | Path) -> set[object]:
    """The files that a name stands for, as device and inode: equal for links to one file."""
    names: list[str] = []
    # what the system cannot look up, as a name with a zero byte or one of 500 characters, is no file
    with contextlib.suppress(OSError, ValueError):
        path = Path(name)
        if path.is_dir():
            names = [str(each) for each in path.iterdir()]
        else:
            names = [str(name)] if path.is_file() else glob.glob(str(name))  # noqa: PTH207 - may be absolute
    found: set[object] = set()
    for each in names:
        # one broken link must not hide the files after it
        with contextlib.suppress(OSError):
            facts = Path(each).stat()
            found.add((facts.st_dev, facts.st_ino))
    return found


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an ``OSError`` of the block into a `UserError` that names ``path``."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(f"{path} cannot be written ({reason}): free disk space or choose another place") from None

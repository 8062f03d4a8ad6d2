"""Read files that may be damaged or hostile, and write files completely or not at all."""

from __future__ import annotations

import codecs
import contextlib
import csv
import glob
import io
import json
import os
import stat
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from psiamfcpp.errors import UserError, brief

# The largest file that is read at once, COCO's annotations, has half a GiB.
_MOST_BYTES = 2**31
# Far above any file of ours. Deeper JSON, or longer whole numbers, break what handles them.
_MOST_DEPTH = 64
_MOST_DIGITS = 300
_BYTE_ORDER_MARKS = {codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}


def read_bytes(path: Path, what: str, fix: str = "replace it", most: int = _MOST_BYTES) -> bytes:
    """Return the content of a regular file; a pipe would be waited for without end, and a device may have no end.

    Args:
        path: the file.
        what: what it holds, for errors.
        fix: what to do about a file that cannot be read, for errors.
        most: number of bytes beyond which it is refused.

    Raises:
        UserError: there is no such file, it cannot be read or is too large.
    """
    with _opened(path, what, fix, most) as file:
        return file.read()


def check_file(path: Path, what: str, fix: str = "replace it", most: int = _MOST_BYTES) -> None:
    """Refuse what `read_bytes` refuses, before a library is given the name.

    Raises:
        UserError: as of `read_bytes`, or the name is not UTF-8, which some libraries crash on.
    """
    with _opened(path, what, fix, most):
        if str(path) != str(path).encode(errors="replace").decode():
            raise UserError(f"{what} {path} cannot be read, its name is not UTF-8: rename it")


def is_file(path: Path) -> bool:
    """Whether there is a regular file; a name that the system cannot look up, as one of 500 characters, is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


@contextlib.contextmanager
def _opened(path: Path, what: str, fix: str, most: int) -> Iterator[BinaryIO]:
    try:
        # without O_NONBLOCK already opening a pipe waits for its writer
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        facts = os.fstat(descriptor)
        if not stat.S_ISREG(facts.st_mode):
            os.close(descriptor)
            raise UserError(f"{what} {path} is not a file: {fix}")
        with os.fdopen(descriptor, "rb") as file:
            if facts.st_size > most:
                raise UserError(f"{what} {path} has {facts.st_size:,} bytes, at most {most:,} are read: {fix}")
            yield file
    except FileNotFoundError:
        raise UserError(f"{what} {path} does not exist: {fix}") from None
    # ValueError: a zero byte in the name
    except (OSError, ValueError) as error:
        raise UserError(f"{what} {path} cannot be read ({getattr(error, 'strerror', None) or error}): {fix}") from None


def read_text(path: Path, what: str, fix: str = "replace it") -> str:
    """Return a text file's content: UTF-8 with or without a byte-order mark, or UTF-16 with one.

    Raises:
        UserError: as of `read_bytes`, or it is no text.
    """
    content = read_bytes(path, what, fix)
    try:
        return content.decode(_BYTE_ORDER_MARKS.get(content[:2], "utf-8-sig"))
    except UnicodeDecodeError as error:
        raise UserError(f"{what} {path} cannot be read (it is no text, {error.reason}): {fix}") from None


def read_table(path: Path, what: str, fix: str = "replace it") -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the rows of a CSV file with a header, each with the number of its line; a cell that is missing is empty.

    Raises:
        UserError: as of `read_text`, or it is no CSV.
    """
    lines = csv.DictReader(io.StringIO(read_text(path, what, fix), newline=""), restval="")
    try:
        for row in lines:
            yield lines.line_num, row
    except csv.Error as error:
        raise UserError(f"{what} {path} cannot be read ({brief(error)}): {fix}") from None


def read_json(path: Path, what: str, fix: str = "replace it") -> Any:
    """Return what a JSON file holds; see `parse_json`.

    Raises:
        UserError: as of `read_text` and `parse_json`.
    """
    return parse_json(read_text(path, what, fix), f"{what} {path}", fix)


def parse_json(text: str, what: str, fix: str = "the file is damaged or foreign") -> Any:
    """Return what a text of JSON holds, NaN and infinite numbers included.

    Raises:
        UserError: it is no JSON, is deeper than any of ours, or holds whole numbers without end.
    """
    try:
        data = json.loads(text, parse_int=_whole_number)
        _check_depth(data)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{what} is not JSON ({brief(error)}): {fix}") from None
    return data


def _whole_number(digits: str) -> int:
    count = len(digits.lstrip("-"))
    if count > _MOST_DIGITS:
        raise ValueError(f"a number of {count} digits")
    return int(digits)


def _check_depth(data: Any) -> None:
    level = [data]
    for _ in range(_MOST_DEPTH):
        if not level:
            return
        level = [
            value
            for each in level
            if isinstance(each, (dict, list))
            for value in (each.values() if isinstance(each, dict) else each)
            if isinstance(value, (dict, list))
        ]
    raise ValueError(f"it is nested more than {_MOST_DEPTH} deep")


def printable(text: object) -> str:
    """Return a text in which what could move a terminal's cursor, or cannot be encoded, is spelled out."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text))


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
        # a file's name that is no UTF-8, as in a table, stays what it is
        temporary.write_bytes(content.encode(errors="surrogateescape") if isinstance(content, str) else content)


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
def reading() -> Iterator[None]:
    """Turn an ``OSError`` of the block, as of a folder of another user or an impossible name, into a `UserError`."""
    try:
        yield
    except OSError as error:
        raise UserError(f"{error.filename} cannot be read ({error.strerror or error}): choose another") from None


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an ``OSError`` of the block into a `UserError` that names ``path``."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(f"{path} cannot be written ({reason}): free disk space or choose another place") from None

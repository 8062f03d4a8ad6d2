"""Result files of MATLAB: the level 5 format ("-v7" and older), as far as the toolkits of correlation filters use it.

Read in Python alone: SciPy's reader ends the whole process on some damaged files. The format is documented in
"MAT-File Format" (The MathWorks).
"""

from __future__ import annotations

import math
import struct
import zlib
from typing import Any

import numpy as np

_HEADER = 128
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_TEXTS = {16: "utf-8", 17: "utf-16", 18: "utf-32"}
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _CHAR = 1, 2, 4
_NUMERIC = range(6, 16)
# Variables of results are a struct, or a cell that holds one.
_MOST_DEPTH = 8
_MOST_BYTES = 2**28


def read_variable(content: bytes, name: str) -> Any:
    """Return a variable of a MATLAB file.

    Args:
        content: the file.
        name: of the variable.

    Returns:
        An array of numbers, a text, or of a struct the fields of its first element, by name; of a cell, its first
        element. None for what is empty or of another class.

    Raises:
        ValueError: the file is none of MATLAB's, is damaged, or lacks the variable.
    """
    try:
        order = {b"IM": "<", b"MI": ">"}[content[126:128]]
    except KeyError:
        raise ValueError("it is no MATLAB file of level 5") from None
    reader = _Reader(content, order, _HEADER)
    while not reader.at_end:
        kind, data = reader.element()
        if kind == _COMPRESSED:
            kind, data = _Reader(_inflated(data), order).element()
        if kind == _MATRIX:
            found, value = _matrix(_Reader(data, order), name)
            if found == name:
                return value
    raise ValueError(f"it holds no variable {name}")


class _Reader:
    """Goes through the elements of a part of a file."""

    def __init__(self, data: bytes, order: str, start: int = 0):
        self._data = data
        self._at = start
        self.order = order

    @property
    def at_end(self) -> bool:
        return self._at >= len(self._data)

    def element(self) -> tuple[int, bytes]:
        """Return the type and the data of the next element."""
        first = self._number(self._at)
        if first >> 16:
            # up to four bytes stand in the tag itself
            kind, size, start, end = first & 0xFFFF, first >> 16, self._at + 4, self._at + 8
        else:
            kind, size, start = first, self._number(self._at + 4), self._at + 8
            end = start + (size if kind == _COMPRESSED else -(-size // 8) * 8)
        if start + size > len(self._data):
            raise ValueError("it is cut off")
        self._at = end
        return kind, self._data[start : start + size]

    def numbers(self) -> Any:
        """Return the next element as an array ``(n,)``."""
        kind, data = self.element()
        if kind not in _NUMBERS:
            raise ValueError(f"it holds data of type {kind} where numbers should be")
        return np.frombuffer(data, self.order + _NUMBERS[kind])

    def _number(self, at: int) -> int:
        if at + 4 > len(self._data):
            raise ValueError("it is cut off")
        return int(struct.unpack_from(self.order + "I", self._data, at)[0])


def _matrix(reader: _Reader, wanted: str | None = None, depth: int = 0) -> tuple[str, Any]:
    """Name and value of a matrix; of one with another name than ``wanted`` the value is passed over."""
    if depth > _MOST_DEPTH:
        raise ValueError("it is nested too deep")
    if reader.at_end:
        return "", None
    flags, shape = reader.numbers(), [int(side) for side in reader.numbers()]
    name = reader.element()[1].decode("latin-1")
    kind = int(flags[0]) & 0xFF if len(flags) else 0
    if (wanted is not None and name != wanted) or min(shape, default=0) <= 0:
        return name, None
    if kind == _CELL:
        return name, _inner(reader, depth)
    if kind == _STRUCT:
        # at most 32 characters each, in as many bytes as the first number says
        length, names = int(next(iter(reader.numbers()), 0)), reader.element()[1]
        starts = range(0, len(names), length) if length > 0 else ()
        return name, {_field(names[start : start + length]): _inner(reader, depth) for start in starts}
    if kind == _CHAR:
        return name, _text(*reader.element(), reader.order)
    if kind in _NUMERIC:
        values = reader.numbers()
        if len(values) != math.prod(shape):
            raise ValueError(f"{len(values)} numbers do not fill {shape}")
        return name, values.reshape(shape, order="F")
    return name, None


def _inner(reader: _Reader, depth: int) -> Any:
    kind, data = reader.element()
    if kind != _MATRIX:
        raise ValueError(f"it holds data of type {kind} where a matrix should be")
    return _matrix(_Reader(data, reader.order), depth=depth + 1)[1]


def _field(name: bytes) -> str:
    return name.partition(b"\0")[0].decode("latin-1")


def _text(kind: int, data: bytes, order: str) -> str:
    if kind in _NUMBERS:
        return "".join(chr(int(number)) for number in np.frombuffer(data, order + _NUMBERS[kind]))
    if kind not in _TEXTS:
        raise ValueError(f"it holds data of type {kind} where a text should be")
    return data.decode(_TEXTS[kind] + ("" if kind == 16 else "-le" if order == "<" else "-be"))


def _inflated(data: bytes) -> bytes:
    machine = zlib.decompressobj()
    try:
        found = machine.decompress(data, _MOST_BYTES)
    except zlib.error as error:
        raise ValueError(f"it is damaged, {error}") from None
    if machine.unconsumed_tail:
        raise ValueError(f"it grows beyond {_MOST_BYTES:,} bytes")
    return found

"""A table as data: what the page, a paper and a terminal show of it is the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

NONE = "\u2013"
_RANKS = ("first", "second", "third")


class Cell(NamedTuple):
    """What stands in one place."""

    text: str
    rank: str = ""
    """first, second or third of its column"""
    heat: str = ""
    """0..1 where the place is shaded by its figure"""


class Row(NamedTuple):
    """One line."""

    name: str
    cells: Sequence[Cell]
    kind: str = ""
    """measured, scored or published; shown beside the name"""


@dataclass(frozen=True)
class Table:
    """Rows under titles."""

    caption: str
    columns: Sequence[str]
    """titles, that of the names first"""
    rows: Sequence[Row]
    groups: Sequence[tuple[str, int]] = ()
    """titles over several columns, with their number; the names have none"""
    prose: Sequence[str] = ()
    """columns of text, which is set to the left"""


def number(value: float | None, rank: str = "", digits: int = 3) -> Cell:
    """Return a figure as a cell; a dash where there is none."""
    return Cell(NONE if value is None else f"{value:.{digits}f}", rank)


def ranks(values: Sequence[float | None]) -> list[str]:
    """Return the rank of each value: of the three highest, where there is anything to rank."""
    known = sorted({round(v, 6) for v in values if v is not None}, reverse=True)[: len(_RANKS)]
    found = dict(zip(known, _RANKS, strict=False)) if len(known) > 1 else {}
    return ["" if v is None else found.get(round(v, 6), "") for v in values]

"""How a recipe reports what it is doing: a note, or progress over the items of a loop."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

Item = TypeVar("Item")


class Track(Protocol):
    """Goes over items as a progress bar does."""

    def __call__(self, items: Iterable[Item], description: str, total: int | None = None) -> Iterable[Item]:
        """Hand on the items; ``total`` is their number where they have no length."""
        ...


def _silent(text: str) -> Any:
    """Drop a note."""


def _plain(items: Iterable[Item], description: str, total: int | None = None) -> Iterable[Item]:
    return items


@dataclass(frozen=True)
class Watch:
    """Callbacks of a recipe; by default it is silent."""

    note: Callable[[str], Any] = _silent
    """is given one line of text"""
    track: Track = _plain
    """goes over the items of a long loop"""


QUIET = Watch()

"""The rank table: average rank of each filter's map, group by group, as a JSON file."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psiamfcpp import files
from psiamfcpp.errors import UserError, brief
from psiamfcpp.geometry import FloatArray

FORMAT = "psiamfcpp-ranks/1"
# Where nine tenths of a group's living filters have ranks within this share of each other, there is nothing to sort by.
FLAT_SPREAD = 0.01


@dataclass(frozen=True)
class View:
    """Ranks over one kind of crop."""

    rank: FloatArray
    """``(n,)`` average rank of each filter's map"""
    max: float
    """highest rank that the map's size allows"""


@dataclass(frozen=True)
class GroupRanks:
    """Average ranks of a group's n filters."""

    rank: FloatArray
    """``(n,)``: mean over all images and, where there are several, all views"""
    max: float | None = None
    """highest rank that the maps' sizes allow, averaged in the same way; None where it is not known"""
    norm: FloatArray | None = None
    """``(n,)``: L2 norm of each filter's weights, the way out where ranks are flat; None where it is not known"""
    parts: int = 1
    """number of blocks of a grouped convolution, which must keep the same positions"""
    views: Mapping[str, View] = field(default_factory=dict)
    """the ranks by kind of crop, where there are several"""
    errors: bool = False
    """whether each number is the error reached with the filter gone and all with lower ones, alike in all groups"""

    @property
    def dead(self) -> int:
        """Filters whose map was zero in every image."""
        return int((self.rank == 0).sum())

    @property
    def flat(self) -> bool:
        """Whether the living filters' ranks are so alike that their order means nothing; errors never are."""
        if self.errors:
            return False
        alive = self.rank[self.rank > 0]
        if not len(alive):
            return True
        low, high = np.percentile(alive, [5, 95])
        return bool(high - low <= FLAT_SPREAD * high)


@dataclass(frozen=True)
class RankTable:
    """Average ranks of a network's groups."""

    images: int
    """number of images, or of pairs of crops, that the ranks are means of"""
    groups: Mapping[str, GroupRanks]
    about: Mapping[str, Any] = field(default_factory=dict)
    """what is known of its making: model, data, search size, tolerance, stability"""

    @property
    def widths(self) -> dict[str, int]:
        """Number of filters of each group."""
        return {name: len(group.rank) for name, group in self.groups.items()}

    def write(self, path: Path) -> None:
        """Write the table as JSON, under a temporary name first.

        Raises:
            UserError: the file cannot be written.
        """
        groups = {name: _group_to_json(group) for name, group in self.groups.items()}
        write_json(path, {"format": FORMAT, "images": self.images, **self.about, "groups": groups})

    @classmethod
    def read(cls, path: Path) -> RankTable:
        """Read a rank table; a group needs only its ``rank``, all else is optional.

        Raises:
            UserError: the file is missing, no such table, or holds numbers that are no ranks.
        """
        data = read_json(path, FORMAT, "rank table", "make it with `psiamfcpp rank`")
        groups, images = data.pop("groups", None), data.pop("images", None)
        if not isinstance(groups, dict) or not groups:
            raise UserError(f"rank table {path} has no groups: make it anew with `psiamfcpp rank`")
        if not isinstance(images, int) or isinstance(images, bool) or images < 0:
            raise UserError(f"rank table {path} is of {brief(repr(images))} images: a whole number is expected")
        return cls(images, {name: _group_from_json(value, name, path) for name, value in groups.items()}, data)


def check_groups(found: Mapping[str, Any], wanted: Mapping[str, Any], what: str) -> None:
    """Refuse a mapping that lacks a group or has one too many.

    Raises:
        UserError: names the groups.
    """
    missing, extra = [name for name in wanted if name not in found], [name for name in found if name not in wanted]
    if missing or extra:
        parts = [f"lacks {', '.join(missing)}"] * bool(missing) + [f"has unknown {brief(', '.join(extra))}"] * bool(
            extra
        )
        raise UserError(f"{what} {' and '.join(parts)}: the groups are {', '.join(wanted)}")


def read_json(path: Path, form: str, what: str, fix: str = "replace it") -> dict[str, Any]:
    """A JSON object of a format of ours, without the format's name.

    Raises:
        UserError: the file is missing, damaged or of another format.
    """
    data = files.read_json(path, what, fix)
    if not isinstance(data, dict) or data.pop("format", None) != form:
        raise UserError(f"{what} {path} is not {form}: the file comes from another program or version")
    return data


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write a JSON object, completely or not at all.

    Raises:
        UserError: the file cannot be written.
    """
    files.write_whole(path, json.dumps(data) + "\n")


def _group_to_json(group: GroupRanks) -> dict[str, Any]:
    row: dict[str, Any] = {"rank": _plain(group.rank), "max": group.max, "dead": group.dead, "flat": group.flat}
    row |= {name: {"rank": _plain(view.rank), "max": view.max} for name, view in group.views.items()}
    if group.norm is not None:
        row["norm"] = _plain(group.norm)
    if group.parts > 1:
        row["parts"] = group.parts
    if group.errors:
        row["errors"] = True
    return row


def _plain(values: FloatArray) -> list[float]:
    return [round(float(v), 6) for v in values]


def _group_from_json(data: Any, name: str, path: Path) -> GroupRanks:
    if not isinstance(data, dict):
        raise UserError(f"{name} in rank table {path} is no object with the key rank")
    rank = _numbers(data.get("rank"), f"rank of {name}", path)
    norm = _numbers(data["norm"], f"norm of {name}", path) if data.get("norm") is not None else None
    if norm is not None and len(norm) != len(rank):
        raise UserError(f"{name} in rank table {path} has {len(rank)} ranks but {len(norm)} norms")
    top, parts = data.get("max"), data.get("parts", 1)
    if top is not None:
        top = float(_numbers([top], f"max of {name}", path)[0])
    if not isinstance(parts, int) or isinstance(parts, bool) or parts < 1 or len(rank) % parts:
        raise UserError(
            f"{name} in rank table {path} has parts {brief(repr(parts))}, which does not divide {len(rank)} filters"
        )
    views = {
        key: View(
            _numbers(value["rank"], f"{key} rank of {name}", path),
            float(_numbers([value["max"]], f"{key} max of {name}", path)[0]),
        )
        for key, value in data.items()
        if isinstance(value, dict) and {"rank", "max"} <= value.keys()
    }
    return GroupRanks(rank, top, norm, parts, views, data.get("errors") is True)


def _numbers(values: Any, what: str, path: Path) -> NDArray[np.float64]:
    if not isinstance(values, list) or not values:
        raise UserError(f"{what} in {path} is no list of numbers")
    for number, value in enumerate(values):
        good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value) and value >= 0
        if not good:
            raise UserError(
                f"{what} in {path} is {brief(repr(value))} at filter {number}: a finite number from 0 up is expected"
            )
    return np.array(values, dtype=np.float64)

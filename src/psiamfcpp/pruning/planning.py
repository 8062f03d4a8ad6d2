"""Which filters to keep: by shares, by thresholds, or within a budget."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.errors import UserError, brief
from psiamfcpp.pruning.table import GroupRanks, RankTable, read_json, write_json

FORMAT = "psiamfcpp-plan/1"


@dataclass(frozen=True)
class Plan:
    """The filters that each group keeps; a group that is not named keeps all."""

    keep: Mapping[str, list[int]]
    """numbers of the kept filters, rising"""

    def __post_init__(self) -> None:
        for name, filters in self.keep.items():
            if not len(filters):
                raise UserError(f"the plan prunes {name} to zero: every group must keep at least one filter")
            bad = [f for f in filters if not isinstance(f, int) or isinstance(f, bool) or f < 0]
            if bad:
                raise UserError(
                    f"the plan keeps filter {brief(repr(bad[0]))} of {name}: filters are numbered 0, 1, 2 ..."
                )
            if len(set(filters)) < len(filters):
                twice = next(f for f, count in Counter(filters).items() if count > 1)
                raise UserError(f"the plan keeps filter {twice} of {name} twice: name each filter once")
        object.__setattr__(self, "keep", {name: sorted(filters) for name, filters in self.keep.items()})

    @property
    def widths(self) -> dict[str, int]:
        """Number of filters that each named group keeps."""
        return {name: len(filters) for name, filters in self.keep.items()}

    def check(self, widths: Mapping[str, int]) -> None:
        """Refuse a plan that is not for a network of these widths.

        Raises:
            UserError: it names a group that is not there, or a filter beyond a group's width.
        """
        for name, filters in self.keep.items():
            if name not in widths:
                raise UserError(f"the plan names {name}, which the network lacks: its groups are {', '.join(widths)}")
            if filters[-1] >= widths[name]:
                raise UserError(
                    f"the plan keeps filter {filters[-1]} of {name}, which has {widths[name]}: plan for this network"
                )

    def write(self, path: Path) -> None:
        """Write the plan as JSON, under a temporary name first.

        Raises:
            UserError: the file cannot be written.
        """
        write_json(path, {"format": FORMAT, "keep": self.keep})

    @classmethod
    def read(cls, path: Path) -> Plan:
        """Read a plan.

        Raises:
            UserError: the file is missing or no plan, or a group in it keeps nothing, a filter twice, or none at all.
        """
        keep = read_json(path, FORMAT, "plan", "make it with `psiamfcpp plan`").get("keep")
        if not isinstance(keep, dict) or not keep or not all(isinstance(filters, list) for filters in keep.values()):
            raise UserError(f"plan {path} has no lists of filters under 'keep': make it anew with `psiamfcpp plan`")
        try:
            return cls(keep)
        except UserError as error:
            raise UserError(f"{path}: {error}") from None


def plan(
    table: RankTable,
    keep: Mapping[str, float] | None = None,
    threshold: Mapping[str, float] | None = None,
) -> Plan:
    """Keep the filters with the highest average ranks (paper, equation 4), in their original order.

    Where a group's ranks are flat, the dead filters go first and then those with the smallest weights.

    Args:
        table: the ranks.
        keep: share KEPT of each group named, above 0 and at most 1; the count is rounded to the nearest.
        threshold: for each group named, the rank above which filters are kept.

    Raises:
        UserError: an unknown group, one named twice, a share out of range, a group left without filters, or a flat
            group without weight norms.
    """
    shares, limits = keep or {}, threshold or {}
    for name in (*shares, *limits):
        if name not in table.groups:
            raise UserError(f"there is no group {name!r} in the rank table: its groups are {', '.join(table.groups)}")
        if name in shares and name in limits:
            raise UserError(f"{name} has both a share and a threshold: give one of them")
    counts = {name: kept_count(name, table.widths[name], share) for name, share in shares.items()}
    for name, limit in limits.items():
        counts[name] = int((table.groups[name].rank > limit).sum())
        if not counts[name]:
            raise UserError(
                f"no filter of {name} has a rank above {limit:g}, its highest is {table.groups[name].rank.max():g}: "
                "lower the threshold"
            )
    return choose(table, counts)


def kept_count(name: str, width: int, share: float) -> int:
    """Round-to-nearest of a share of a group's width.

    Raises:
        UserError: the share is not above 0 and at most 1, or leaves nothing.
    """
    if not 0 < share <= 1:
        raise UserError(f"the share of {name} to keep is {share:g}: it must lie above 0 and be at most 1")
    count = int(share * width + 0.5)
    if not count:
        raise UserError(f"keeping {share:g} of the {width} filters of {name} leaves none: give a larger share")
    return count


def choose(table: RankTable, counts: Mapping[str, int]) -> Plan:
    """Return the plan that keeps a number of filters of each group; of a group not named, all.

    Raises:
        UserError: a flat group is to be pruned, but the table holds no weight norms; or a grouped convolution cannot
            keep that number.
    """
    return Plan(
        {
            name: sorted(int(f) for f in order(name, group, counts.get(name, len(group.rank)))[: counts[name]])
            if name in counts and counts[name] < len(group.rank)
            else list(range(len(group.rank)))
            for name, group in table.groups.items()
        }
    )


def order(name: str, group: GroupRanks, count: int) -> NDArray[np.intp]:
    """A group's filters, those to keep first: by rank, or by weight norm where living ones with flat ranks must go.

    Equal filters stay in their original order. Where a grouped convolution parts the filters, the same positions of
    each part come together, ordered by their mean.

    Args:
        name: of the group, for errors.
        group: its ranks.
        count: how many are to be kept.

    Raises:
        UserError: see `choose`.
    """
    keys = [group.rank]
    if group.flat and count < (group.rank > 0).sum():
        if group.norm is None:
            raise UserError(f"ranks of {name} are flat and its table holds no weight norms: keep the group whole")
        keys = [(group.rank > 0).astype(float), group.norm]
    if count % group.parts:
        raise UserError(
            f"{name} feeds a grouped convolution: keep a multiple of {group.parts} of its filters, not {count}"
        )
    positions = len(group.rank) // group.parts
    means = [key.reshape(group.parts, positions).mean(axis=0) for key in keys]
    # lexsort sorts by its last key first, and rising.
    best = np.lexsort([-mean for mean in reversed(means)])
    return np.concatenate([best[k : k + 1] + positions * np.arange(group.parts) for k in range(positions)])


def plan_for_budget(
    table: RankTable,
    cost: Callable[[Mapping[str, int]], float],
    budget: float,
    flat_too: bool = False,
    multiple: int = 1,
) -> Plan:
    """Lose as little rank as meets the budget.

    The loss is the sum over groups of the squared log of the share of its rank that a group keeps. A log, because each
    layer passes on what it was given and shares multiply; squared, because a layer cut to a sliver is a bottleneck that
    no other can make good. Where the table holds errors, it is the sum of those that groups reach. Greedy: of all
    groups' next filters, those with the smallest ratio of loss to saved cost go first.

    Args:
        table: the ranks.
        cost: of a network of given widths.
        budget: highest cost allowed, in the same unit.
        flat_too: prune groups with flat ranks as well, by weight norm; otherwise they stay whole.
        multiple: number whose multiples the widths of pruned groups are.

    Raises:
        UserError: the budget cannot be met.
    """
    widths = dict(table.widths)
    free = [name for name, group in table.groups.items() if flat_too or not group.flat]
    losses = {name: _losses(table.groups[name]) for name in free}
    current = cost(widths)
    while current > budget:
        best: tuple[float, str, int, float] | None = None
        for name in free:
            # In steps of about one in fifty, so that a plan takes hundreds of looks at the cost and not thousands.
            parts = table.groups[name].parts
            step = max(1, table.widths[name] // (50 * parts)) * parts
            left = (widths[name] - step) // (multiple * parts) * multiple * parts
            if left < 1:
                continue
            saved = current - cost({**widths, name: left})
            lost = float(losses[name][left] - losses[name][widths[name]])
            if saved > 0 and (best is None or lost / saved < best[0]):
                best = (lost / saved, name, left, saved)
        if best is None:
            raise UserError(
                f"a budget of {budget:.4g} cannot be met: {current:.4g} is the least"
                + ("; raise it" if flat_too else " while groups with flat ranks stay whole; raise it, or give --flat")
            )
        widths[best[1]] = best[2]
        current -= best[3]
    return choose(table, widths)


def _losses(group: GroupRanks) -> NDArray[np.float64]:
    """Loss ``(n + 1,)`` of keeping 0, 1, ... n filters of the highest ranks; of keeping none at all, infinite."""
    if group.errors:
        # Of n filters kept, the error is that of the best one to go.
        return np.concatenate([[np.inf], np.sort(group.rank)[::-1][1:], [0.0]])
    kept = np.cumsum(np.sort(group.rank)[::-1])
    shares = kept / kept[-1] if kept[-1] else np.ones(len(kept))
    return np.concatenate([[np.inf], np.log(shares) ** 2])


def rows(table: RankTable, chosen: Plan) -> list[dict[str, Any]]:
    """What a plan does to each group.

    Returns:
        ``group``, ``kept``, ``removed``, ``cut`` (highest rank that goes; None where all stay), ``dead``, ``flat``.
    """
    result = []
    for name, group in table.groups.items():
        kept = np.zeros(len(group.rank), dtype=bool)
        kept[chosen.keep.get(name, range(len(group.rank)))] = True
        result.append(
            {
                "group": name,
                "kept": int(kept.sum()),
                "removed": int((~kept).sum()),
                "cut": float(group.rank[~kept].max()) if not kept.all() else None,
                "dead": group.dead,
                "flat": group.flat,
            }
        )
    return result

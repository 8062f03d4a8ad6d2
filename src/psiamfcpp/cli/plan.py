"""`psiamfcpp plan`."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from psiamfcpp.cli.output import notes, print_json
from psiamfcpp.errors import UserError
from psiamfcpp.spec import FULL_WIDTHS, ModelSpec

if TYPE_CHECKING:
    from psiamfcpp.pruning.planning import Plan
    from psiamfcpp.pruning.table import RankTable


def plan(
    ranks: Annotated[Path, tyro.conf.Positional],
    preset: Literal["paper"] | None = None,
    keep: tuple[str, ...] = (),
    remove: float | None = None,
    threshold: tuple[str, ...] = (),
    target_macs: float | None = None,
    target_latency: float | None = None,
    flat: bool = False,
    search_size: int | None = None,
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None,
    json: bool = False,
) -> None:
    """Choose the filters to keep, and say what that saves. Give exactly one of the first six options.

    Args:
        ranks: table that `psiamfcpp rank` wrote.
        preset: the paper's shares.
        keep: GROUP=SHARE: share of the group's filters to KEEP; groups not named stay whole.
        remove: share of the filters to REMOVE from every group, those with flat ranks apart.
        threshold: GROUP=RANK: keep the filters whose average rank lies above; groups not named stay whole.
        target_macs: share of the multiply-accumulates of a search crop to come down to, at the smallest loss of rank.
        target_latency: milliseconds that a search crop may take here, measured on all cores; likewise.
        flat: let `--remove` and the targets prune groups with flat ranks too, by weight norm.
        search_size: side of the search crop to count and to measure at; the ranked model's by default.
        output: plan to write, .json.
        json: print one JSON object.
    """
    given = (preset, keep or None, remove, threshold or None, target_macs, target_latency)
    if sum(option is not None for option in given) != 1:
        raise UserError(
            "give exactly one of --preset, --keep, --remove, --threshold, --target-macs and --target-latency"
        )
    from psiamfcpp.pruning import planning
    from psiamfcpp.pruning.table import RankTable, check_groups

    table = RankTable.read(ranks)
    check_groups(table.groups, FULL_WIDTHS, f"rank table {ranks}")
    size = search_size or table.about.get("search_size", ModelSpec().search_size)
    ModelSpec(widths=table.widths, search_size=size)
    if preset:
        chosen = planning.plan(table, planning.PAPER_KEEP)
    elif remove is not None:
        if not 0 < remove < 1:
            raise UserError(f"the share to remove is {remove:g}: it must lie between 0 and 1")
        names = [name for name, group in table.groups.items() if flat or not group.flat]
        chosen = planning.plan(table, dict.fromkeys(names, 1 - remove))
    elif target_macs is not None or target_latency is not None:
        chosen = _within_budget(table, size, target_macs, target_latency, flat)
    else:
        chosen = planning.plan(table, _parse("keep", "SHARE", keep), _parse("threshold", "RANK", threshold))
    if output:
        chosen.write(output)
    rows = planning.rows(table, chosen)
    before, after = _facts(table.widths, size), _facts(chosen.widths, size)
    for row in rows:
        if row["flat"] and row["removed"] > row["dead"]:
            notes.print(f"{row['group']}: ranks are flat, so the filters to remove were chosen by weight norm")
    if json:
        print_json({"before": before, "after": after, "search_size": size, "groups": rows})
        return
    print(f"{'group':15}  kept  removed  highest rank removed  dead")
    for row in rows:
        cut = "-" if row["cut"] is None else f"{row['cut']:.2f}"
        note = "  flat" if row["flat"] else ""
        print(f"{row['group']:15} {row['kept']:5} {row['removed']:8} {cut:>21} {row['dead']:5}{note}")
    print(f"parameters  {before['parameters']:,} -> {after['parameters']:,}")
    print(f"search      {before['gmacs']:.2f} -> {after['gmacs']:.2f} GMAC at {size} pixels")


def _parse(option: str, value: str, entries: tuple[str, ...]) -> dict[str, float]:
    """Numbers by group from ``GROUP=NUMBER``."""
    numbers: dict[str, float] = {}
    for entry in entries:
        name, equals, number = entry.partition("=")
        try:
            parsed = float(number)
        except ValueError:
            equals = ""
        if not equals:
            raise UserError(f"--{option} {entry!r} is not GROUP={value}: a group's name, '=' and a number")
        if name in numbers:
            raise UserError(f"--{option} names {name} twice: give it once")
        numbers[name] = parsed
    return numbers


def _facts(widths: Mapping[str, int], size: int) -> dict[str, Any]:
    """What `psiamfcpp info` says of a network of these widths."""
    import torch

    from psiamfcpp.models import SiamFCpp
    from psiamfcpp.models.cost import count_parameters, search_macs

    with torch.device("meta"):
        parameters = count_parameters(SiamFCpp(ModelSpec(widths=dict(widths), search_size=size)))
    return {"parameters": parameters, "gmacs": search_macs(widths, size) / 1e9, "widths": dict(widths)}


def _within_budget(table: RankTable, size: int, macs: float | None, milliseconds: float | None, flat: bool) -> Plan:
    """The plan that meets a share of the multiply-accumulates, or a time."""
    from psiamfcpp.models.cost import search_macs
    from psiamfcpp.pruning.planning import plan_for_budget

    full = search_macs(table.widths, size)

    def at(share: float) -> Plan:
        return plan_for_budget(table, lambda widths: search_macs(widths, size), share * full, flat)

    if macs is not None:
        if not 0 < macs <= 1:
            raise UserError(f"the share of multiply-accumulates is {macs:g}: it must lie above 0 and be at most 1")
        return at(macs)
    assert milliseconds is not None
    return _within_time(at, table.widths, size, milliseconds)


def _within_time(at: Callable[[float], Plan], widths: Mapping[str, int], size: int, milliseconds: float) -> Plan:
    """The plan with the largest share of multiply-accumulates, to a 64th, that is quick enough when measured."""
    fastest = _milliseconds(widths, size)
    notes.print(f"unpruned: {fastest:.2f} ms")
    if fastest <= milliseconds:
        return at(1.0)
    low, high, chosen = 0.0, 1.0, None
    for _ in range(6):
        share = (low + high) / 2
        try:
            candidate = at(share)
        except UserError:
            low = share  # no plan is as small as that
            continue
        took = _milliseconds(candidate.widths, size)
        notes.print(f"{share:.3f} of the multiply-accumulates: {took:.2f} ms")
        fastest = min(fastest, took)
        if took <= milliseconds:
            chosen, low = candidate, share
        else:
            high = share
    if chosen is None:
        raise UserError(f"no plan takes {milliseconds:g} ms a search crop here: {fastest:.2f} ms is the least measured")
    return chosen


def _milliseconds(widths: Mapping[str, int], size: int) -> float:
    """Median time of a search crop in the fastest engine, by a network of random weights."""
    import numpy as np

    from psiamfcpp.models import SiamFCpp, save
    from psiamfcpp.runtime import open_engine

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "candidate.safetensors"
        save(path, SiamFCpp(ModelSpec(widths=dict(widths), search_size=size)))
        engine = open_engine(str(path))
        rng = np.random.default_rng(0)
        kernels = engine.template(rng.integers(0, 256, (engine.spec.template_size,) * 2 + (3,), np.uint8))
        crop = rng.integers(0, 256, (size, size, 3), np.uint8)
        times = []
        for _ in range(15):
            start = time.perf_counter()
            engine.search(crop, kernels)
            times.append(time.perf_counter() - start)
    return 1000 * float(np.median(times[3:]))

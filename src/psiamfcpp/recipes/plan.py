"""Choose the filters that a model keeps: by shares, thresholds, or within a budget of operations or of time."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from psiamfcpp.datasets.choice import HELD_OUT_EVERY
from psiamfcpp.errors import UserError
from psiamfcpp.export.crops import Pair
from psiamfcpp.export.files import graphs_of, write_files
from psiamfcpp.export.graph import Ranges
from psiamfcpp.export.layers import layers
from psiamfcpp.export.quantize import measure
from psiamfcpp.models import build
from psiamfcpp.models.arch import DEFAULT, architecture
from psiamfcpp.models.cost import facts, search_macs
from psiamfcpp.pruning import planning
from psiamfcpp.pruning.planning import Plan, plan_for_budget
from psiamfcpp.pruning.table import RankTable, check_groups
from psiamfcpp.recipes.scoring import score_model
from psiamfcpp.runtime import open_engine, usable_cores
from psiamfcpp.runtime.timing import search_milliseconds
from psiamfcpp.spec import ModelSpec
from psiamfcpp.watch import QUIET, Watch


@dataclass(frozen=True)
class Timing:
    """How a network is run to be timed; the defaults are those of the shipped models."""

    engine: Literal["onnx", "openvino"] = "onnx"
    """engine that runs the graphs"""
    precision: Literal["int8", "fp32"] = "int8"
    """what the search graph computes in"""
    threads: int | None = None
    """threads of the engine; by default as many as there are cores"""

    def __str__(self) -> str:
        """Return what is timed, in words."""
        return f"{self.precision} graphs in {self.engine} on {self.threads or usable_cores()} threads"


@dataclass(frozen=True)
class Planned:
    """A plan and what it saves."""

    plan: Plan
    rows: list[dict[str, Any]]
    """by group, see `psiamfcpp.pruning.planning.rows`"""
    before: dict[str, Any]
    """``parameters``, ``gmacs`` and ``widths`` of the network before"""
    after: dict[str, Any]
    """the same of what the plan keeps"""
    search_size: int
    """side of the search crop that operations and times are of, pixels"""
    times: dict[str, Any] | None = None
    """milliseconds of a search crop ``before`` and ``after``, and the `Timing`; None where no time was asked for"""


def plan(
    source: RankTable | str | Path,
    *,
    criterion: str = "rank",
    ranks: str | Path | None = None,
    data: Sequence[str] = (),
    images: int = 100,
    held_out_every: int = HELD_OUT_EVERY,
    preset: str | None = None,
    keep: Mapping[str, float] | None = None,
    remove: float | None = None,
    threshold: Mapping[str, float] | None = None,
    target_macs: float | None = None,
    target_latency: float | None = None,
    flat: bool = False,
    multiple: int = 1,
    search_size: int | None = None,
    timing: Timing = Timing(),
    watch: Watch = QUIET,
) -> Planned:
    """Choose the filters to keep.

    Exactly one of ``preset``, ``keep``, ``remove``, ``threshold``, ``target_macs`` and ``target_latency`` is given.

    Args:
        source: a rank table, or its .json file; or the model, to score its filters by another criterion.
        criterion: of a model: a name of `psiamfcpp.pruning.CRITERIA`, or ``MODULE:FUNCTION``.
        ranks: of a model: its rank table, for the criterion rank.
        data: of a model: sets to run the training loss on, for the criterion taylor, or to draw crops from, for
            refit; each LAYOUT:FOLDER.
        images: of a model: pairs of crops for the criterion refit.
        held_out_every: the N of training: one clip in N is not drawn from; 0 draws from all.
        preset: name of the architecture's shares, such as ``paper``.
        keep: share of the filters to KEEP by group; groups not named stay whole.
        remove: share of the filters to REMOVE from every group, those with flat scores apart.
        threshold: by group: keep the filters whose score lies above; groups not named stay whole.
        target_macs: share of the multiply-accumulates of a search crop to come down to, at the smallest loss of score.
        target_latency: milliseconds that a search crop may take on this machine; likewise.
        flat: let ``remove`` and the targets prune groups with flat scores too, by weight norm.
        multiple: with a target: number whose multiples the widths of pruned groups are.
        search_size: side of the search crop to count and to time at; by default that of the table's model.
        timing: how candidates are run to be timed.
        watch: receives each time.

    Raises:
        UserError: not exactly one option, a value out of range, a table of other groups, or a target out of reach.
    """
    given = (preset, keep or None, remove, threshold or None, target_macs, target_latency)
    if sum(option is not None for option in given) != 1:
        raise UserError(
            "give exactly one of --preset, --keep, --remove, --threshold, --target-macs and --target-latency"
        )
    if multiple < 1:
        raise UserError(f"multiple is {multiple}: it must be at least 1")
    table = _table(source, criterion, ranks, data, images, held_out_every)
    spec = spec_of(table, search_size)
    times = None
    if preset is not None:
        if preset not in spec.arch.presets:
            known = ", ".join(spec.arch.presets) or "none"
            raise UserError(f"unknown preset {preset!r}: {spec.architecture} has {known}")
        chosen = planning.plan(table, spec.arch.presets[preset])
    elif remove is not None:
        if not 0 < remove < 1:
            raise UserError(f"the share to remove is {remove:g}: it must lie between 0 and 1")
        names = [name for name, group in table.groups.items() if flat or not group.flat]
        chosen = planning.plan(table, dict.fromkeys(names, 1 - remove))
    elif target_macs is not None:
        if not 0 < target_macs <= 1:
            raise UserError(
                f"the share of multiply-accumulates is {target_macs:g}: it must lie above 0 and be at most 1"
            )
        chosen = _at(table, spec, target_macs, flat, multiple)
    elif target_latency is not None:
        watch.note(f"timing {timing}, with weights at random: what `psiamfcpp export` would write")
        chosen, found = _within_time(table, spec, target_latency, flat, multiple, timing, watch)
        times = {**found, **dataclasses.asdict(timing), "threads": timing.threads or usable_cores()}
    else:
        chosen = planning.plan(table, keep, threshold)
    before, after = (facts(_with(spec, widths)) for widths in (table.widths, chosen.widths))
    return Planned(chosen, planning.rows(table, chosen), before, after, spec.search_size, times)


def _table(
    source: RankTable | str | Path,
    criterion: str,
    ranks: str | Path | None,
    data: Sequence[str],
    images: int,
    held_out_every: int,
) -> RankTable:
    """Return the table to plan with, read or made."""
    if not isinstance(source, RankTable) and Path(source).suffix != ".json":
        return score_model(source, criterion, ranks=ranks, data=data, images=images, held_out_every=held_out_every)
    if criterion != "rank" or ranks or data:
        what = "this" if isinstance(source, RankTable) else source
        raise UserError(f"{what} is a rank table, which needs no criterion, ranks or data: give the model instead")
    return source if isinstance(source, RankTable) else RankTable.read(Path(source))


def spec_of(table: RankTable, search_size: int | None = None) -> ModelSpec:
    """Return the spec of the model that a table is of: its architecture, widths and search size.

    Raises:
        UserError: the table is of other groups than the architecture's, or the search size does not fit it.
    """
    name = table.about.get("architecture", DEFAULT)
    if not isinstance(name, str):
        raise UserError(f"the rank table is of architecture {name!r}: make it anew with `psiamfcpp rank`")
    arch = architecture(name)
    check_groups(table.groups, arch.groups, "the rank table")
    size = search_size or table.about.get("search_size", arch.search_size)
    if not isinstance(size, int) or isinstance(size, bool):
        raise UserError(f"the rank table is of search size {size!r}: make it anew with `psiamfcpp rank`")
    return ModelSpec(table.widths, arch.template_size, size, architecture=name)


def milliseconds(spec: ModelSpec, timing: Timing) -> float:
    """Return the median time of a search crop with the graphs of a network of these widths, its weights random.

    The graphs are written to a temporary folder and opened by the engine, as those of a shipped model are.
    """
    weights = layers(build(spec).eval())
    rng = np.random.default_rng(0)
    template, search = (rng.integers(0, 256, (s, s, 3), np.uint8) for s in (spec.template_size, spec.search_size))
    ranges = measure(spec, weights, [Pair(template, search)]) if timing.precision == "int8" else Ranges()
    with tempfile.TemporaryDirectory() as folder:
        write_files(graphs_of(spec, weights, ranges), Path(folder), "onnx")
        return search_milliseconds(open_engine(folder, timing.engine, timing.threads))


def _at(table: RankTable, spec: ModelSpec, share: float, flat: bool, multiple: int) -> Plan:
    """The plan that meets a share of the multiply-accumulates."""

    def cost(widths: Mapping[str, int]) -> int:
        return spec.arch.macs(widths, spec.search_size)

    return plan_for_budget(table, cost, share * search_macs(spec), flat, multiple)


def _within_time(
    table: RankTable, spec: ModelSpec, limit: float, flat: bool, multiple: int, timing: Timing, watch: Watch
) -> tuple[Plan, dict[str, float]]:
    """The plan with the largest share of multiply-accumulates, to a 64th, that is quick enough when measured."""
    whole = milliseconds(spec, timing)
    watch.note(f"unpruned: {whole:.2f} ms")
    if whole <= limit:
        return _at(table, spec, 1.0, flat, multiple), {"before": whole, "after": whole}
    low, high, fastest = 0.0, 1.0, whole
    chosen: Plan | None = None
    for _ in range(6):
        share = (low + high) / 2
        try:
            candidate = _at(table, spec, share, flat, multiple)
        except UserError:
            low = share  # no plan is as small as that
            continue
        took = milliseconds(_with(spec, candidate.widths), timing)
        watch.note(f"{share:.3f} of the multiply-accumulates: {took:.2f} ms")
        fastest = min(fastest, took)
        if took <= limit:
            chosen, low, reached = candidate, share, took
        else:
            high = share
    if chosen is None:
        raise UserError(
            f"no plan takes {limit:g} ms a search crop here ({timing}): {fastest:.2f} ms is the least measured"
        )
    return chosen, {"before": whole, "after": reached}


def _with(spec: ModelSpec, widths: Mapping[str, int]) -> ModelSpec:
    return dataclasses.replace(spec, widths=dict(widths))

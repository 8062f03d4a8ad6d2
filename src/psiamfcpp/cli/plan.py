"""`psiamfcpp plan`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from psiamfcpp.cli.arguments import HeldOut, Json, Overwrite, SourceName
from psiamfcpp.cli.output import check_new, print_json, watching
from psiamfcpp.datasets.choice import HELD_OUT_EVERY
from psiamfcpp.errors import UserError
from psiamfcpp.files import check_outputs


def plan(
    source: SourceName,
    criterion: str = "rank",
    ranks: Path | None = None,
    data: tuple[str, ...] = (),
    images: int = 100,
    held_out_every: HeldOut = HELD_OUT_EVERY,
    preset: Literal["paper"] | None = None,
    keep: tuple[str, ...] = (),
    remove: float | None = None,
    threshold: tuple[str, ...] = (),
    target_macs: float | None = None,
    target_latency: float | None = None,
    engine: Literal["onnx", "openvino"] = "onnx",
    precision: Literal["int8", "fp32"] = "int8",
    threads: int | None = None,
    flat: bool = False,
    multiple: int = 1,
    search_size: int | None = None,
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Choose the filters to keep, and say what that saves.

    Give exactly one of --preset, --keep, --remove, --threshold, --target-macs and --target-latency.

    Args:
        source: table that `psiamfcpp rank` wrote, .json; or the model, to score its filters by another criterion.
        criterion: rank (the paper's), norm, median, taylor, random, refit (which changes least before fine-tuning), or
            MODULE:FUNCTION, a function f(group, context) -> scores (n,).
        ranks: with a model: its rank table, for the criterion rank.
        data: with a model: sets to run the training loss on, for the criterion taylor, or to draw crops from, for
            refit; each LAYOUT:FOLDER.
        images: with a model: pairs of crops for the criterion refit, drawn as by `psiamfcpp rank`.
        preset: the paper's shares.
        keep: GROUP=SHARE: share of the group's filters to KEEP; groups not named stay whole.
        remove: share of the filters to REMOVE from every group, those with flat scores apart.
        threshold: GROUP=SCORE: keep the filters whose score, or average rank, lies above; groups not named stay whole.
        target_macs: share of the multiply-accumulates of a search crop to come down to, at the smallest loss of score.
        target_latency: milliseconds that a search crop may take here, with the graphs that would be shipped; likewise.
        engine: with --target-latency: what runs the graphs.
        precision: with --target-latency: what the graphs compute in.
        threads: with --target-latency: threads of the engine; by default as many as there are cores.
        flat: let `--remove` and the targets prune groups with flat scores too, by weight norm.
        multiple: with a target: number whose multiples the widths of pruned groups are, as engines compute channels in
            blocks.
        search_size: side of the search crop to count and to time at; that of the model by default.
        output: plan to write, .json.
    """
    from psiamfcpp.recipes import plan as recipe

    check_outputs([output], [source, ranks])
    check_new([output], overwrite)
    with watching() as watch:
        done = recipe.plan(
            source,
            criterion=criterion,
            ranks=ranks,
            data=data,
            images=images,
            held_out_every=held_out_every,
            preset=preset,
            keep=_parse("keep", "SHARE", keep),
            remove=remove,
            threshold=_parse("threshold", "SCORE", threshold),
            target_macs=target_macs,
            target_latency=target_latency,
            flat=flat,
            multiple=multiple,
            search_size=search_size,
            timing=recipe.Timing(engine, precision, threads),
            watch=watch,
        )
        for row in done.rows:
            if row["flat"] and row["removed"] > row["dead"]:
                watch.note(f"{row['group']}: scores are flat, so the filters to remove were chosen by weight norm")
    if output:
        done.plan.write(output)
    if json:
        facts = {name: getattr(done, name) for name in ("before", "after", "search_size", "times")}
        print_json({"criterion": criterion, **facts, "groups": done.rows})
        return
    print(f"{'group':15}  kept  removed  highest {criterion} removed  dead")
    for row in done.rows:
        cut = "-" if row["cut"] is None else f"{row['cut']:.2f}"
        note = "  flat" if row["flat"] else ""
        print(
            f"{row['group']:15} {row['kept']:5} {row['removed']:8} {cut:>{len(criterion) + 17}} {row['dead']:5}{note}"
        )
    print(f"parameters  {done.before['parameters']:,} -> {done.after['parameters']:,}")
    print(f"search      {done.before['gmacs']:.2f} -> {done.after['gmacs']:.2f} GMAC at {done.search_size} pixels")
    if done.times:
        timing = recipe.Timing(engine, precision, threads)
        print(f"time        {done.times['before']:.2f} -> {done.times['after']:.2f} ms a search crop, {timing}")


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

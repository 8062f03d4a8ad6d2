"""`psiamfcpp sensitivity`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import tyro

from psiamfcpp.cli.output import print_json, progress
from psiamfcpp.errors import UserError
from psiamfcpp.training.options import Schedule, TrainOptions

_SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
_SHORT = TrainOptions(schedule=Schedule(steps=200, lr=3e-4), batch=16, ema=0.99)


def sensitivity(
    model: Annotated[str, tyro.conf.Positional],
    ranks: Path,
    root: Path,
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    data: tuple[str, ...] = (),
    options: TrainOptions = _SHORT,
    rows: tuple[str, ...] = (),
    shares: tuple[float, ...] = _SHARES,
    jobs: int = 1,
    json: bool = False,
) -> None:
    """What pruning each layer costs in precision, by share kept, and what other criteria make of the paper's widths.

    Every network is measured by one-pass evaluation with the plain procedure. The folder keeps a file for each, so that
    the same command goes on where it was stopped, and table.csv, which grows; sensitivity.png comes at the end.

    Args:
        model: name of a shipped model, or a model file.
        ranks: its rank table.
        root: folder of sequences to measure on.
        output: folder of the results.
        data: training sets, each LAYOUT:FOLDER; with them every network is measured after fine-tuning as well.
        options: of the fine-tuning.
        rows: layers to prune alone; by default the paper's nine rows.
        shares: shares of their filters to KEEP.
        jobs: processes to share the work, one thread each.
        json: print one JSON object.
    """
    from psiamfcpp.pruning import report
    from psiamfcpp.pruning.sensitivity import ROWS, Setup, cells, measure_all

    unknown = next((row for row in rows if row not in ROWS), None)
    if unknown is not None:
        raise UserError(f"unknown row {unknown!r}: known are {', '.join(ROWS)}")
    wrong = next((share for share in shares if not 0 < share <= 1), None)
    if wrong is not None:
        raise UserError(f"the share to keep is {wrong:g}: it must lie above 0 and be at most 1")
    if jobs < 1:
        raise UserError(f"jobs is {jobs}: it must be at least 1")
    setup = Setup(model, ranks, root, data, options)
    wanted = cells(setup, rows or tuple(ROWS), shares)
    order = {(c.row, c.share, c.criterion, c.tuned): number for number, c in enumerate(wanted)}
    done: list[dict[str, Any]] = []
    with progress() as bar:
        for result in bar.track(measure_all(setup, wanted, output, jobs), total=len(wanted), description="networks"):
            done.append(result)
            done.sort(key=lambda r: order[r["row"], r["share"], r["criterion"], r["tuned"]])
            report.write_csv(done, output / "table.csv")
    report.draw_sensitivity(done, output / "sensitivity.png")
    if json:
        print_json({"cells": done})
        return
    print(f"unpruned: precision {done[0]['precision']:.3f}, AUC {done[0]['auc']:.3f}\n")
    for tuned in sorted({r["tuned"] for r in done}):
        print(f"precision, {'fine-tuned' if tuned else 'not fine-tuned'}")
        print(report.ratio_table(done, tuned) + "\n")
    print(report.criteria_table(done))

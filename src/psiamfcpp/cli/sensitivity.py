"""`psiamfcpp sensitivity`."""

from __future__ import annotations

from pathlib import Path

from psiamfcpp.cli.arguments import Json, Model, Output
from psiamfcpp.cli.output import print_json, watching
from psiamfcpp.training.options import SHORT, TrainOptions


def sensitivity(
    model: Model,
    ranks: Path,
    root: Path,
    output: Output,
    data: tuple[str, ...] = (),
    options: TrainOptions = SHORT,
    rows: tuple[str, ...] = (),
    shares: tuple[float, ...] = (),
    jobs: int = 1,
    json: Json = False,
) -> None:
    """Measure what pruning each layer costs in precision, by share kept, and compare criteria on the paper's widths.

    Every network is measured by one-pass evaluation with the plain procedure. The folder keeps a file for each, so that
    the same command goes on where it was stopped, and table.csv, which grows; sensitivity.png comes at the end.

    Args:
        ranks: its rank table.
        root: folder of sequences to measure on.
        output: folder of the results.
        data: training sets, each LAYOUT:FOLDER; with them every network is measured after fine-tuning as well.
        options: of the fine-tuning.
        rows: layers to prune alone; by default the architecture's rows, for SiamFC++ the paper's nine.
        shares: shares of their filters to KEEP; by default 0.1, 0.2 ... 0.8.
        jobs: processes to share the work, one thread each.
    """
    from psiamfcpp.recipes import sensitivity as recipe
    from psiamfcpp.recipes.sensitivity_report import criteria_table, ratio_table

    with watching() as watch:
        done = recipe.sensitivity(
            model, ranks, root, output, data=data, options=options, rows=rows, shares=shares, jobs=jobs, watch=watch
        )
    if json:
        print_json({"cells": done})
        return
    print(f"unpruned: precision {done[0]['precision']:.3f}, AUC {done[0]['auc']:.3f}\n")
    for tuned in sorted({r["tuned"] for r in done}):
        print(f"precision, {'fine-tuned' if tuned else 'not fine-tuned'}")
        print(ratio_table(done, tuned) + "\n")
    print(criteria_table(done))

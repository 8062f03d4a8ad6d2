"""`psiamfcpp reproduce`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from psiamfcpp.cli.output import notes, print_json, watching
from psiamfcpp.recipes.reproduce import Reproduced, there
from psiamfcpp.recipes.reproduce import reproduce as run_all
from psiamfcpp.report.compare import title
from psiamfcpp.report.layout import NONE, Cell, Row, Table, as_text


def reproduce(
    root: Path | None = None,
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None,
    table: tuple[int, ...] = (),
    checkouts: tuple[str, ...] = (),
    results: tuple[Path, ...] = (),
    ranks: Path | None = None,
    data: tuple[str, ...] = (),
    finetune_steps: int = 200,
    jobs: int = 1,
    cluster: str | None = None,
    dry_run: bool = False,
    json: bool = False,
) -> None:
    """Run the paper's tables and figures, and write one page with ours beside every published cell.

    Without frames, result files are scored; without anything, the published tables are printed. The same command goes
    on where it was stopped. Table 4 is run only with --ranks or --data.

    Args:
        root: folder that holds the benchmarks' folders.
        output: folder for results, page, tables and plots.
        table: tables to make, 1 to 4; by default all.
        checkouts: deep trackers of Table 2, each NAME,checkout=DIR,weights=FILE[,python=PY][,device=cuda].
        results: folders of boxes of others, scored beside ours.
        ranks: rank table of siamfcpp-alexnet for Table 4; by default made from --data.
        data: training sets for Table 4, each LAYOUT:FOLDER; without them nothing is fine-tuned.
        finetune_steps: budget of fine-tuning of each network of Table 4.
        jobs: sequences that are run side by side; leave it at 1 to measure speed.
        cluster: run on the workers of a Dask scheduler (tcp://HOST:PORT) instead.
        dry_run: say what would be run and how long it takes; run and write nothing.
        json: print one JSON object.
    """
    with watching() as watch:
        done = run_all(
            root, output, table, checkouts, results, ranks, data, finetune_steps, jobs, cluster, dry_run, watch
        )
    for problem in done.problems:
        notes.print(problem)
    if json:
        print_json(_as_json(done))
        return
    if root is not None:
        print(as_text(there(done.found)) + "\n")
    if dry_run:
        print(as_text(_plan(done, jobs)))
        return
    print("\n\n".join(as_text(made) for made in done.tables.values()))
    if done.files:
        print(f"\n{done.files[0]} and {len(done.files) - 1} files beside it")


def _plan(done: Reproduced, jobs: int) -> Table:
    rows = [
        Row(
            title(part.dataset),
            [Cell(part.tracker), Cell(str(part.sequences)), Cell(str(part.frames)), Cell(_duration(part.seconds))],
        )
        for part in done.planned
    ]
    total = sum(part.seconds or 0.0 for part in done.planned)
    side = f", about {_duration(total / jobs)} with {jobs} side by side" if jobs > 1 else ""
    caption = f"To be run: about {_duration(total)} in one process{side}, from a few frames of each tracker."
    columns = ["Benchmark", "Tracker", "Sequences", "Frames", "Time"]
    return Table(caption if rows else "Nothing is left to be run.", columns, rows, prose=["Tracker"])


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return NONE
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min" if minutes else f"{seconds:.0f} s"


def _as_json(done: Reproduced) -> dict[str, object]:
    return {
        "found": {name: place and dataclasses.asdict(place) for name, place in done.found.items()},
        "planned": [dataclasses.asdict(part) for part in done.planned],
        "problems": done.problems,
        "tables": {
            number: {
                "caption": table.caption,
                "groups": [list(group) for group in table.groups],
                "columns": list(table.columns),
                "rows": [[row.name, row.kind, *(cell.text for cell in row.cells)] for row in table.rows],
            }
            for number, table in done.tables.items()
        },
        "files": [str(path) for path in done.files],
    }

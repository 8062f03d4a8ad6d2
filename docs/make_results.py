"""Keep the figures of the project in docs/results.csv, and make the page docs/results.md of them.

    psiamfcpp evaluate --root SEVEN --tracker MODEL --threads 1 --json > seven.json
    python docs/make_results.py add seven.json --set seven --procedure states \
        --command "psiamfcpp evaluate --root SEVEN --tracker MODEL"
    python docs/make_results.py write

Each row of the table is one figure with the command that prints it. `add` replaces the figures of the same set, tracker
and procedure. Tests compare page, README and model cards with the table.
"""

from __future__ import annotations

import csv
import io
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro

from psiamfcpp.errors import UserError
from psiamfcpp.files import read_json, read_text, write_whole

TABLE = Path(__file__).with_name("results.csv")
PAGE = Path(__file__).with_name("results.md")
# What stands before and after the part of the page that is made.
BEGIN, END = "<!-- made by docs/make_results.py -->\n", "<!-- end -->\n"

SETS = {
    "fifteen": (
        "Fifteen sequences",
        "Fifteen sequences of UAV123@10fps, DTB70 and UAVDT, eight of them as H.264; one pass, `otb` convention, one\n"
        "thread. SEVEN and EIGHT are their two folders, FIFTEEN is one of all. One lost target moves a mean by 0.07.",
    ),
    "seven": (
        "Seven sequences",
        "The seven of them with original frames, 869 frames. One lost target moves a mean by 0.14.",
    ),
    "update": (
        "Time of an update",
        "Milliseconds, the median; two threads on an AMD EPYC with VNNI ([speed](speed.md)).",
    ),
}
"""title and description of each set of figures, by name"""
_TITLES = {"precision": "precision", "auc": "AUC", "ms": "ms"}


class Figure(NamedTuple):
    """One row of the table."""

    set: str
    tracker: str
    procedure: str
    """``states`` or ``plain`` of our models; empty for others"""
    figure: str
    """``precision``, ``auc`` or ``ms``"""
    value: str
    """as it is shown"""
    command: str


def add(files: tyro.conf.Positional[tuple[Path, ...]], set: str, procedure: str, command: str) -> None:
    """Put the figures of runs into the table.

    Args:
        files: what `psiamfcpp evaluate --json` printed; the means are over the sequences of all.
        set: fifteen or seven.
        procedure: states or plain; an empty text for trackers of others.
        command: the command, with MODEL for the tracker.
    """
    if set not in SETS:
        raise UserError(f"unknown set {set!r}: known are {', '.join(SETS)}")
    found: dict[str, list[dict[str, float]]] = {}
    for path in files:
        for row in read_json(path, "figures")["results"]:
            if row["convention"] == "otb":
                found.setdefault(row["tracker"], []).extend(row["sequences"].values())
    figures = read()
    for tracker, sequences in found.items():
        figures = [f for f in figures if (f.set, f.tracker, f.procedure) != (set, tracker, procedure)]
        for name in ("precision", "auc"):
            mean = np.mean([sequence[name] for sequence in sequences])
            figures.append(Figure(set, tracker, procedure, name, f"{mean:.3f}", command.replace("MODEL", tracker)))
    written = io.StringIO()
    rows = csv.writer(written, lineterminator="\n")
    rows.writerow(Figure._fields)
    rows.writerows(figures)
    write_whole(TABLE, written.getvalue().encode())


def write() -> None:
    """Write the tables of the page; the rest of it stays."""
    write_whole(PAGE, page(read_text(PAGE, "page")).encode())


def read() -> list[Figure]:
    """Return all figures."""
    header, *rows = csv.reader(io.StringIO(read_text(TABLE, "table of figures")))
    if tuple(header) != Figure._fields:
        raise UserError(f"{TABLE} has the columns {', '.join(header)}: {', '.join(Figure._fields)} are needed")
    return [Figure(*row) for row in rows]


def page(text: str) -> str:
    """Return the page with the tables made anew."""
    before, after = text.split(BEGIN)[0], text.split(END)[1]
    return before + BEGIN + "".join(f"\n{table(name)}" for name in SETS) + "\n" + END + after


def table(name: str) -> str:
    """Return a set of figures as a section of the page: one row for each tracker and procedure, with its command."""
    figures = [figure for figure in read() if figure.set == name]
    kinds = list(dict.fromkeys(figure.figure for figure in figures))
    title, about = SETS[name]
    lines = [f"## {title}", "", about, ""]
    lines += [f"| tracker | procedure | {' | '.join(_TITLES[kind] for kind in kinds)} | command |"]
    lines += ["|---" * (len(kinds) + 3) + "|"]
    for tracker, procedure in dict.fromkeys((figure.tracker, figure.procedure) for figure in figures):
        of_row = {f.figure: f for f in figures if (f.tracker, f.procedure) == (tracker, procedure)}
        values = " | ".join(of_row[kind].value for kind in kinds)
        lines += [f"| `{tracker}` | {procedure} | {values} | `{of_row[kinds[0]].command}` |"]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    try:
        tyro.extras.subcommand_cli_from_dict({"add": add, "write": write})
    except UserError as error:
        print(f"make_results.py: {error}", file=sys.stderr)
        sys.exit(2)

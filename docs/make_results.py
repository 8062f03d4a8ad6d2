"""Keep the figures of the project in docs/results.csv, and make docs/results.md and its picture of them.

    psiamfcpp evaluate --root SEVEN --tracker MODEL --threads 1 --json > seven.json
    python docs/make_results.py add seven.json --set seven --procedure states \
        --command "psiamfcpp evaluate --root SEVEN --tracker MODEL"
    psiamfcpp bench --threads 1 --engines onnx --json > times.json
    python docs/make_results.py add times.json --set avx2 --command "psiamfcpp bench --engines onnx"
    python docs/make_results.py write

Each row of the table is one figure with the command that prints it. `add` replaces the same figures of the same set,
tracker and procedure. Tests compare page, README and model cards with the table.
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
from psiamfcpp.zoo import graph_names

TABLE = Path(__file__).with_name("results.csv")
PAGE = Path(__file__).with_name("results.md")
CHART = Path(__file__).with_name("images") / "precision-time.svg"
# What stands before and after the part of the page that is made.
BEGIN, END = "<!-- made by docs/make_results.py -->\n", "<!-- end -->\n"

SETS = {
    "fifteen": (
        "Fifteen sequences",
        "Fifteen sequences of UAV123@10fps, DTB70 and UAVDT, eight of them as H.264; one pass, `otb` convention, one\n"
        "thread. SEVEN and EIGHT are their two folders, FIFTEEN is one of all. One lost target moves a mean by 0.07.\n"
        "Our models gave the same boxes with AVX-512 and without it; the others were followed with AVX2.",
    ),
    "seven": (
        "Seven sequences",
        "The seven of them with original frames, 869 frames. One lost target moves a mean by 0.14.",
    ),
    "update": (
        "Time of an update",
        "Milliseconds, the median, on two cores of an AMD EPYC (Zen 4) with AVX-512 VNNI ([speed](speed.md)), shared\n"
        "with other machines: a fixed piece of work took up to 1.2 times its least time.",
    ),
    "avx2": (
        "Time of an update without VNNI",
        "Milliseconds, the median, on an AMD EPYC with AVX2 but no VNNI, where products of 8 bits take more\n"
        "instructions. Other programs shared the machine: a fixed piece of work took up to 1.8 times its least time.\n"
        "Compare rows of one command, not with the table above. KCF and CSRT were timed in a run of their own.",
    ),
}
"""title and description of each set of figures, by name"""
_TITLES = {"precision": "precision", "auc": "AUC", "ms": "ms", "ms1": "ms, one thread", "ms2": "ms, two threads"}
# What `bench` calls trackers of others, and what the tables do.
_NAMES = {
    "nanotrack-v3": "NanoTrack v3",
    "lightfc-float": "LightFC",
    "opencv-nano": "NanoTrack v2",
    **{f"opencv-{name.lower()}": name for name in ("MIL", "KCF", "CSRT")},
}


class Figure(NamedTuple):
    """One row of the table."""

    set: str
    tracker: str
    procedure: str
    """``states`` or ``plain`` of our models; empty for others"""
    figure: str
    """``precision``, ``auc``; ``ms``, or ``ms1`` and ``ms2`` by the number of threads"""
    value: str
    """as it is shown"""
    command: str


class Point(NamedTuple):
    """A tracker in the picture."""

    tracker: str
    ms: float
    precision: float


def add(files: tyro.conf.Positional[tuple[Path, ...]], set: str, command: str, procedure: str = "") -> None:
    """Put the figures of runs into the table.

    Args:
        files: what `psiamfcpp evaluate --json` printed, whose means are over the sequences of all files, or what
            `psiamfcpp bench --json` printed.
        set: name of the set: fifteen, seven, update, avx2.
        command: the command, with MODEL for the tracker.
        procedure: states or plain; empty for trackers of others. Of a bench it is known.
    """
    if set not in SETS:
        raise UserError(f"unknown set {set!r}: known are {', '.join(SETS)}")
    found: list[tuple[str, str, str, str]] = []
    sequences: dict[str, list[dict[str, float]]] = {}
    for path in files:
        run = read_json(path, "figures")
        for row in run.get("rows", []):
            tracker, ours = _NAMES.get(row["model"], row["model"]), row["model"] in graph_names()
            found.append((tracker, "plain" if ours else "", f"ms{run['threads']}", f"{row['ms_median']:.1f}"))
        for row in run.get("results", []):
            if row["convention"] == "otb":
                sequences.setdefault(row["tracker"], []).extend(row["sequences"].values())
    for tracker, rows in ((_NAMES.get(name, name), rows) for name, rows in sequences.items()):
        for name in ("precision", "auc"):
            found.append((tracker, procedure, name, f"{np.mean([row[name] for row in rows]):.3f}"))
    if not found:
        raise UserError("the files hold no figures: give what `evaluate --json` or `bench --json` of psiamfcpp printed")
    figures = {figure[:4]: figure for figure in read()}
    for row_tracker, row_procedure, name, value in found:
        figure = Figure(set, row_tracker, row_procedure, name, value, command.replace("MODEL", row_tracker))
        figures[figure[:4]] = figure
    written = io.StringIO()
    table_rows = csv.writer(written, lineterminator="\n")
    table_rows.writerow(Figure._fields)
    table_rows.writerows(figures.values())
    write_whole(TABLE, written.getvalue().encode())


def write() -> None:
    """Write the tables of the page, whose other text stays, and the picture."""
    write_whole(PAGE, page(read_text(PAGE, "page")).encode())
    write_whole(CHART, chart(points()))


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


def points() -> list[Point]:
    """Return what the picture shows: trackers whose precision on the fifteen and whose time without VNNI are known."""
    known = {(figure.set, figure.tracker, figure.procedure, figure.figure): float(figure.value) for figure in read()}
    times = {tracker: ms for (name, tracker, _, kind), ms in known.items() if (name, kind) == ("avx2", "ms1")}
    found = []
    for tracker, ms in times.items():
        keys = [("fifteen", tracker, procedure, "precision") for procedure in ("states", "")]
        found += [Point(tracker, ms, known[key]) for key in keys if key in known]
    return found


def front(points: list[Point]) -> list[Point]:
    """Return those that no other beats in both time and precision, the fastest first."""
    found: list[Point] = []
    for point in sorted(points, key=lambda point: (point.ms, -point.precision)):
        if not found or point.precision > found[-1].precision:
            found.append(point)
    return found


def chart(points: list[Point]) -> bytes:
    """Return precision against time as SVG; a line joins the front."""
    import matplotlib

    matplotlib.use("svg")
    from matplotlib import pyplot as plt

    # Text stays text, which the fonts of the reader draw; ids come from the salt: equal figures, equal files.
    plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "precision-time"})
    figure, axes = plt.subplots(figsize=(7.2, 3.8), layout="constrained")
    best = front(points)
    axes.plot([p.ms for p in best], [p.precision for p in best], color="#1b7f5c", linewidth=1.2, zorder=1)
    for name, ms, precision in points:
        axes.scatter(ms, precision, s=40, color="#1b7f5c" if name.endswith("-int8") else "#888888", zorder=2)
        # Below its point where the name of a near one stands above.
        below = any(0 <= p.precision - precision < 0.05 and 0 < abs(np.log(p.ms / ms)) < 0.9 for p in points)
        axes.annotate(name, (ms, precision), xytext=(5, 5 - 16 * below), textcoords="offset points", fontsize=8)
    axes.set_xscale("log")
    axes.set_xticks(ticks := [2, 5, 10, 20, 50, 100, 200], [str(tick) for tick in ticks])
    axes.set_xlabel("milliseconds an update, one thread without VNNI")
    axes.set_ylabel("precision on the fifteen")
    axes.grid(alpha=0.25)
    axes.set_xlim(right=4 * max(p.ms for p in points))  # room for the last names
    axes.margins(y=0.1)
    written = io.BytesIO()
    figure.savefig(written, format="svg", metadata={"Date": None})
    plt.close(figure)
    return written.getvalue()


if __name__ == "__main__":
    try:
        tyro.extras.subcommand_cli_from_dict({"add": add, "write": write})
    except UserError as error:
        print(f"make_results.py: {error}", file=sys.stderr)
        sys.exit(2)

"""The report as one HTML page that needs nothing beside it: style and pictures are inside."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable
from html import escape
from pathlib import Path
from typing import Any

from psiamfcpp.evaluation.measured import CONVENTIONS
from psiamfcpp.evaluation.metrics import Convention
from psiamfcpp.report.compare import PAPER, Comparison, average
from psiamfcpp.report.published import Published, averaged, pruned_layers
from psiamfcpp.report.tables import FIGURES, by_attribute, rows, speed_columns
from psiamfcpp.version import __version__

_STYLE = Path(__file__).with_name("report.css")
_CONVENTIONS = {
    "otb": "a row without a valid label counts as a precision hit and an overlap miss",
    "got10k": "rows without a label are dropped",
}
_HEAD = ("Tracker", "Precision", "Norm. precision", "AUC", "Success@0.5")
_RANKS = ("first", "second", "third")


def page(
    comparisons: list[Comparison],
    averages: list[Published],
    plots: dict[str, bytes],
    strips: dict[str, str],
    files: Iterable[str],
) -> str:
    """The page.

    Args:
        comparisons: what to show, a section a benchmark.
        averages: the paper's averages over its benchmarks.
        plots: SVG by file name without its suffix: ``precision-<dataset>-<convention>``, ``success-...``,
            ``speed-...``, with ``average`` among the datasets.
        strips: HTML of the strips of frames by benchmark (see `strip`); no entry where there are none.
        files: names of the files beside the page.
    """
    names = ", ".join(c.title for c in comparisons)
    parts = [_overview(comparisons)] if len(comparisons) > 1 else []
    parts += [_benchmark(c, plots, strips.get(c.dataset, "")) for c in comparisons]
    parts += [_paper(averages, plots)]
    picks = "".join(
        f'<input class="pick" type="radio" name="convention" id="pick-{kind}"{" checked" if kind == "otb" else ""}>'
        for kind in CONVENTIONS
    )
    labels = "".join(f'<label for="pick-{kind}">{kind}</label>' for kind in CONVENTIONS)
    links = ", ".join(f'<a href="{escape(name)}">{escape(name)}</a>' for name in files)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Tracking on {escape(names)}</title>
<style>
{_STYLE.read_text()}</style>
</head>
<body>
<h1>Tracking on {escape(names)}</h1>
<p class="soft">One-pass evaluation by psiamfcpp {__version__}. Precision: centre error of at most 20 pixels. AUC: area
under the success curve. <span class="first">First</span>, <span class="second">second</span> and
<span class="third">third</span> of the measured rows are marked.</p>
{picks}
<div class="bar"><span class="soft">Convention</span>{labels}</div>
<main>
{_per_convention(lambda kind: f'<p class="soft"><b>{kind}</b>: {_CONVENTIONS[kind]}.</p>')}
{"".join(parts)}
</main>
<footer><details><summary>Files beside this page</summary><p>{links}</p></details></footer>
</body>
</html>
"""


def strip(sequence: str, trackers: list[str], styles: dict[str, tuple[str, str]], frames: dict[int, bytes]) -> str:
    """One strip of frames with its legend; the frames are JPEG, by their number in the sequence."""
    chips = _chip("label", "#ffffff") + "".join(_chip(name, styles[name][0]) for name in trackers)
    images = "".join(
        f'<figure><img src="{_data("jpeg", frame)}" alt=""><figcaption>#{number}</figcaption></figure>'
        for number, frame in frames.items()
    )
    return f'<div class="strip"><b>{escape(sequence)}</b><p>{chips}</p><div class="frames">{images}</div></div>'


def _overview(comparisons: list[Comparison]) -> str:
    def table(kind: Convention) -> str:
        trackers = list(dict.fromkeys(entry.tracker for c in comparisons for entry in c.measured))
        figures = {
            name: [
                average(group, name, kind, key)
                for group in [*([c] for c in comparisons), comparisons]
                for key in ("precision", "auc")
            ]
            for name in trackers
        }
        trackers.sort(key=lambda name: -(figures[name][-2] or -1))
        ranks = [_ranks([figures[name][i] for name in trackers]) for i in range(2 * len(comparisons) + 2)]
        head = "".join(f'<th colspan="2">{escape(c.title)}</th>' for c in comparisons) + '<th colspan="2">Average</th>'
        body = "".join(
            f"<tr><th>{escape(name)}</th>"
            + "".join(_number(value, ranks[i][row]) for i, value in enumerate(figures[name]))
            + "</tr>"
            for row, name in enumerate(trackers)
        )
        sub = "<th></th>" + "<th>Prec.</th><th>AUC</th>" * (len(comparisons) + 1)
        return _table(f"<tr><th>Tracker</th>{head}</tr><tr>{sub}</tr>", body, f"Measured, convention {kind}.")

    return f"<section><h2>All benchmarks</h2>{_per_convention(table)}</section>"


def _benchmark(comparison: Comparison, plots: dict[str, bytes], frames: str) -> str:
    invalid = {kind: max((m.mean[kind].invalid for m in comparison.measured), default=0) for kind in CONVENTIONS}
    facts = f"{len(comparison.sequences)} sequences, {comparison.labels} labels"
    missing = [f"{m.tracker}: {m.missing} missing" for m in comparison.measured if m.missing]
    lacks = f'<p class="soft">Without all sequences: {escape(", ".join(missing))}.</p>' if missing else ""
    strips = f"<h3>Frames</h3>{frames}" if frames else ""

    def body(kind: Convention) -> str:
        pictures = "".join(
            f'<img src="{_data("svg+xml", plots[name])}" alt="{what} plot of {escape(comparison.title)}">'
            for what in ("precision", "success", "speed")
            if (name := f"{what}-{comparison.dataset}-{kind}") in plots
        )
        return (
            f'<p class="soft">{facts}, of which {invalid[kind]} are invalid under {kind}.</p>{lacks}'
            f'<div class="plots">{pictures}</div>{_figures(comparison, kind)}{_attributes(comparison, kind)}'
            f"{_sequences(comparison, kind)}"
        )

    ratios = _pruning_ratios(comparison.dataset)
    return f"<section><h2>{escape(comparison.title)}</h2>{_per_convention(body)}{strips}{ratios}</section>"


def _figures(comparison: Comparison, kind: Convention) -> str:
    listed = rows(comparison, kind)
    speeds = speed_columns(listed)
    keys = (*FIGURES, *speeds)
    ranks = {key: _ranks([row[key] if row["kind"] == "measured" else None for row in listed]) for key in keys}
    body = "".join(
        f'<tr class="{row["kind"]}"><th>{escape(row["tracker"])} {_tag(row["kind"])}</th>'
        + "".join(_number(row[key], ranks[key][i], 1 if key in speeds else 3) for key in keys)
        + f'<td class="text">{escape(row["source"])}</td></tr>'
        for i, row in enumerate(listed)
    )
    head = "".join(f"<th>{name}</th>" for name in (*_HEAD, *speeds.values())) + '<th class="text">Source</th>'
    elsewhere = sum(row.convention not in (kind, None) for row in comparison.published)
    note = f" {elsewhere} published rows follow the other convention, and are shown with it." if elsewhere else ""
    return f"<h3>Figures</h3>{_table(f'<tr>{head}</tr>', body, f'Convention {kind}.{note}')}"


def _attributes(comparison: Comparison, kind: Convention) -> str:
    if not comparison.attributes:
        return ""
    found = {entry.tracker: by_attribute(comparison, entry, kind) for entry in comparison.measured}
    lines = [
        (f"{name} ({len(comparison.attributes[name])})", [by_name.get(name) for by_name in found.values()])
        for name in comparison.attributes
    ]
    note = (
        "Precision / AUC over the sequences of each attribute; the number of them in brackets. The benchmark's files "
    )
    note += "do not name their columns: see the documentation on attributes."
    return f"<details><summary>By attribute</summary>{_grid(list(found), lines, note)}</details>"


def _sequences(comparison: Comparison, kind: Convention) -> str:
    lines = [(name, [entry.figures[kind].get(name) for entry in comparison.measured]) for name in comparison.sequences]
    trackers = [entry.tracker for entry in comparison.measured]
    return f"<details><summary>By sequence</summary>{_grid(trackers, lines, 'Precision / AUC.')}</details>"


def _grid(trackers: list[str], lines: list[tuple[str, list[dict[str, float] | None]]], note: str) -> str:
    """A row a sequence or attribute, a column a tracker."""
    body = "".join(
        f"<tr><th>{escape(name)}</th>"
        + "".join(
            "<td>&ndash;</td>"
            if f is None
            else f'<td class="heat" style="--v:{f["auc"]:.2f}">{f["precision"]:.3f} / {f["auc"]:.3f}</td>'
            for f in cells
        )
        + "</tr>"
        for name, cells in lines
    )
    head = "".join(f"<th>{escape(name)}</th>" for name in trackers)
    return _table(f"<tr><th></th>{head}</tr>", body, note)


def _paper(averages: list[Published], plots: dict[str, bytes]) -> str:
    """What the paper printed as averages over its benchmarks; it says of no row what convention that follows."""

    def picture(kind: Convention) -> str:
        name = f"speed-average-{kind}"
        return f'<img src="{_data("svg+xml", plots[name])}" alt="precision and speed">' if name in plots else ""

    lines = "".join(
        f'<tr class="published"><th>{escape(row.tracker)} {_tag("published")}</th>'
        f"{_number(row.precision)}{_number(row.fps_cpu, digits=1)}{_number(row.fps_gpu, digits=1)}"
        f'<td class="text">{row.convention or "unknown"}</td>'
        f'<td class="text">{PAPER}, {escape(row.source.partition(",")[0])}</td></tr>'
        for row in averages
    )
    head = "".join(f"<th>{name}</th>" for name in ("Tracker", "Precision", "FPS (CPU)", "FPS (GPU)"))
    head += '<th class="text">Convention</th><th class="text">Source</th>'
    caption = f"Averages over {len(averaged())} benchmarks, as printed: the convention is not the same in every row. "
    caption += "Speeds were measured on an i9-10850K and a TitanX."
    table = _table(f"<tr>{head}</tr>", lines, caption)
    pictures = f'<div class="plots">{_per_convention(picture)}</div>'
    return f"<section><h2>Published averages</h2>{pictures}{table}</section>"


def _pruning_ratios(dataset: str) -> str:
    layers = [layer for layer in pruned_layers() if layer.dataset == dataset]
    if not layers:
        return ""
    head = "".join(f"<th>{ratio:g}</th>" for ratio in layers[0].precision)
    body = "".join(
        f'<tr class="published"><th>{escape(layer.layer)}</th>'
        + "".join(_number(value) for value in layer.precision.values())
        + "</tr>"
        for layer in layers
    )
    note = f"Precision of P-SiamFC++ by the pruning ratio that the paper prints. {PAPER}, {layers[0].source}."
    table = _table(f"<tr><th>Pruned</th>{head}</tr>", body, note)
    return f"<details><summary>Published: precision by pruning ratio</summary>{table}</details>"


def _per_convention(part: Callable[[Convention], str]) -> str:
    return "".join(f'<div class="{kind}">{part(kind)}</div>' for kind in CONVENTIONS)


def _table(head: str, body: str, caption: str) -> str:
    # Outside of what scrolls: on a phone a caption as wide as its table could not be read.
    inside = f"<table><thead>{head}</thead><tbody>{body}</tbody></table>"
    return f'<p class="soft">{escape(caption)}</p><div class="scroll">{inside}</div>'


def _ranks(values: list[Any]) -> list[str]:
    """The class of each value: that of the three highest, if there is anything to rank."""
    known = sorted({round(v, 6) for v in values if v is not None}, reverse=True)[: len(_RANKS)]
    ranks = dict(zip(known, _RANKS, strict=False)) if len(known) > 1 else {}
    return ["" if v is None else ranks.get(round(v, 6), "") for v in values]


def _number(value: float | None, rank: str = "", digits: int = 3) -> str:
    shown = "&ndash;" if value is None else f"{value:.{digits}f}"
    return f'<td class="{rank}">{shown}</td>' if rank else f"<td>{shown}</td>"


def _tag(kind: str) -> str:
    return f'<span class="tag {kind}">{kind}</span>'


def _chip(name: str, colour: str) -> str:
    return f'<span class="chip"><i style="background:{colour}"></i>{escape(name)}</span>'


def _data(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"

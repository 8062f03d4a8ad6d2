"""The report as one HTML page that needs nothing beside it: style and images are inside."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from psiamfcpp.evaluation.metrics import Convention
from psiamfcpp.report.compare import PAPER, Comparison, average
from psiamfcpp.report.layout import NONE, Cell, Row, Table, number, ranks
from psiamfcpp.report.published import Published, averaged, pruned_layers
from psiamfcpp.report.tables import by_attribute, difference_table, figures_table, share
from psiamfcpp.version import __version__

MEANINGS: dict[Convention, str] = {
    "otb": "a row without a valid label counts as a precision hit and an overlap miss",
    "got10k": "rows without a label are dropped",
}


class ShownStrip(NamedTuple):
    """One strip of frames: the trackers with their colours, and JPEG images by number in the sequence."""

    sequence: str
    chips: list[tuple[str, str]]
    frames: list[tuple[int, str]]


def page(
    comparisons: list[Comparison],
    averages: list[Published],
    plots: Mapping[str, bytes],
    strips: Mapping[str, list[ShownStrip]],
    files: Iterable[str],
    percent: bool = False,
) -> str:
    """Return the page.

    Args:
        comparisons: what to show, a section per benchmark.
        averages: the paper's averages over its benchmarks; none where these were not all evaluated.
        plots: SVG by file name without its suffix: ``precision-<dataset>-<convention>``, ``success-...``,
            ``speed-...``, ``attributes-...``, with ``average`` among the datasets; ``overlap-<dataset>-<sequence>``.
        strips: strips of frames by benchmark.
        files: names of the files beside the page.
        percent: show shares as percent.
    """
    return render(
        "page.html.j2",
        title=f"Tracking on {', '.join(c.title for c in comparisons)}",
        comparisons=comparisons,
        overview=lambda found, kind: _overview(found, kind, percent),
        plots=lambda dataset, kind: _plots(plots, dataset, kind),
        overlaps=lambda dataset: _overlaps(plots, dataset),
        figures=lambda c, kind: figures_table(c, kind, percent),
        differences=difference_table,
        attributes=lambda c, kind: _attributes(c, kind, percent),
        sequences=lambda c, kind: _sequences(c, kind, percent),
        ratios={c.dataset: _pruning_ratios(c.dataset) for c in comparisons},
        averages=_averages(averages),
        strips=strips,
        files=list(files),
    )


def render(template: str, **values: Any) -> str:
    """Return a template of this folder, filled; text is escaped, since names of trackers and sequences are others'."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    folder = FileSystemLoader(Path(__file__).parent)
    made = Environment(
        loader=folder, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    ).get_template(template)
    return made.render(conventions=MEANINGS, version=__version__, **values)


def data_address(kind: str, content: bytes) -> str:
    """Return an image as an address that holds it; ``kind`` is jpeg or svg+xml."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def _plots(plots: Mapping[str, bytes], dataset: str, kind: Convention) -> list[tuple[str, str]]:
    """Return what each plot of a benchmark shows, and its address."""
    found = {what: plots.get(f"{what}-{dataset}-{kind}") for what in ("precision", "success", "speed", "attributes")}
    return [(what, data_address("svg+xml", content)) for what, content in found.items() if content is not None]


def _overlaps(plots: Mapping[str, bytes], dataset: str) -> list[tuple[str, str]]:
    start = f"overlap-{dataset}-"
    return [
        (f"{name.removeprefix(start)}: overlap over time", data_address("svg+xml", content))
        for name, content in plots.items()
        if name.startswith(start)
    ]


def _overview(comparisons: list[Comparison], kind: Convention, percent: bool) -> Table:
    trackers = list(dict.fromkeys(entry.tracker for c in comparisons for entry in c.measured))
    groups = [*([c] for c in comparisons), comparisons]
    found = {t: [average(g, t, kind, key) for g in groups for key in ("precision", "auc")] for t in trackers}
    trackers.sort(key=lambda name: -(found[name][-2] or -1))
    columns = [ranks(column) for column in zip(*(found[name] for name in trackers), strict=True)]
    return Table(
        f"Convention {kind}.",
        ["Tracker"] + ["Prec.", "AUC"] * len(groups),
        [
            Row(t, [share(v, percent, columns[i][row]) for i, v in enumerate(found[t])])
            for row, t in enumerate(trackers)
        ],
        groups=[*((c.title, 2) for c in comparisons), ("Average", 2)],
    )


def _attributes(comparison: Comparison, kind: Convention, percent: bool) -> Table:
    found = {entry.tracker: by_attribute(comparison, entry, kind) for entry in comparison.measured}
    note = "Precision / AUC over the sequences of each attribute; their number in brackets. The benchmark's files do "
    note += "not name their columns: see the documentation on attributes."
    named = [(name, of) for name, of in comparison.attributes.items() if of]
    lines = {f"{name} ({len(of)})": [f.get(name) for f in found.values()] for name, of in named}
    return _grid(note, found, lines, percent)


def _sequences(comparison: Comparison, kind: Convention, percent: bool) -> Table:
    entries = comparison.measured
    lines = {name: [entry.figures[kind].get(name) for entry in entries] for name in comparison.sequences}
    return _grid("Precision / AUC.", [entry.tracker for entry in entries], lines, percent)


def _grid(
    note: str, trackers: Iterable[str], lines: Mapping[str, list[dict[str, float] | None]], percent: bool
) -> Table:
    """Return a table of a row per sequence or attribute and a column per tracker."""

    def cell(found: dict[str, float] | None) -> Cell:
        if found is None:
            return Cell(NONE)
        shown = " / ".join(share(found[key], percent).text for key in ("precision", "auc"))
        return Cell(shown, heat=f"{found['auc']:.2f}")

    return Table(note, ["", *trackers], [Row(name, list(map(cell, figures))) for name, figures in lines.items()])


def _averages(averages: list[Published]) -> Table:
    """Return what the paper printed as averages over its benchmarks."""
    return Table(
        f"Averages over {len(averaged())} benchmarks, as printed: the convention is not the same in every row. "
        "Speeds were measured on an i9-10850K and a TitanX.",
        ["Tracker", "Precision", "FPS (CPU)", "FPS (GPU)", "Convention", "Source"],
        [
            Row(r.tracker, [number(r.precision), number(r.fps_cpu, digits=1), number(r.fps_gpu, digits=1),
                            Cell(r.convention or "unknown"), Cell(_source(r.source))], "published")
            for r in averages
        ],
        prose=["Convention", "Source"],
    )  # fmt: skip


def _pruning_ratios(dataset: str) -> Table | None:
    layers = [layer for layer in pruned_layers() if layer.dataset == dataset]
    if not layers:
        return None
    return Table(
        f"Precision of P-SiamFC++ by the pruning ratio that the paper prints. {PAPER}, {layers[0].source}.",
        ["Pruned", *(f"{ratio:g}" for ratio in layers[0].precision)],
        [Row(layer.layer, [number(v) for v in layer.precision.values()], "published") for layer in layers],
    )


def _source(text: str) -> str:
    return f"{PAPER}, {text.partition(',')[0]}"

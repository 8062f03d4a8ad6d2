"""The paper's plots: precision and success curves with a ranked legend, and precision against speed."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from psiamfcpp.evaluation.measured import Measured
from psiamfcpp.evaluation.metrics import OVERLAP_THRESHOLDS, PRECISION_THRESHOLDS, Convention
from psiamfcpp.evaluation.results import read_result
from psiamfcpp.geometry import FloatArray, overlap
from psiamfcpp.report.compare import PAPER, Comparison, average
from psiamfcpp.report.published import Published, averaged
from psiamfcpp.report.tables import by_attribute

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Ten colours that remain distinct with a colour vision deficiency as well as ten can; then again, dashed.
COLOURS = (
    "#d62728", "#1f5fbf", "#2a9d3f", "#e69f00", "#8e44ad", "#0097a7", "#8c564b", "#e377c2", "#707070", "#a8a800",
)  # fmt: skip
Styles = dict[str, tuple[str, str]]
"""colour and line style by tracker"""
_DASHES = ("-", "--", ":", "-.")
_REAL_TIME = 30
# More lines than these cannot be distinguished.
_RADAR, _LINES = 8, 5
_FPS_TICKS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000)
_NAME_SIZE = 8
# in points, the likeliest first
_NAME_OFFSETS = ((6, 0), (-6, 0), (0, 9), (0, -9), (6, 9), (6, -9), (-6, 9), (-6, -9), (0, 18), (0, -18))
_STYLE: Any = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    # names of trackers are no formulas
    "text.parse_math": False,
    # letters as outlines look the same everywhere, and the same figures give the same file
    "svg.fonttype": "path",
    "svg.hashsalt": "psiamfcpp",
}


def colours(comparisons: list[Comparison]) -> Styles:
    """Return a colour and a line style per tracker, the same in every plot of a report; the best come first."""
    ranks: dict[str, list[float]] = {}
    for comparison in comparisons:
        for entry in comparison.measured:
            ranks.setdefault(entry.tracker, []).append(entry.mean["otb"].figures["precision"])
    names = sorted(ranks, key=lambda name: -float(np.mean(ranks[name])))
    return {
        name: (COLOURS[i % len(COLOURS)], _DASHES[i // len(COLOURS) % len(_DASHES)]) for i, name in enumerate(names)
    }


def curves(
    comparison: Comparison,
    kind: Literal["precision", "success"],
    convention: Convention,
    styles: Styles,
) -> Figure:
    """Return the curves of all trackers on one benchmark, ranked by the figure in brackets.

    That is precision at 20 pixels or the area under the success curve, as in the paper's Fig. 2.
    """
    figure, axes = _figure(height=3.1 + 0.17 * ((len(comparison.measured) + 1) // 2))
    key = "precision" if kind == "precision" else "auc"
    ranked = sorted(comparison.measured, key=lambda entry: -entry.mean[convention].figures[key])
    for place, entry in enumerate(ranked):
        mean, (colour, dash) = entry.mean[convention], styles[entry.tracker]
        x = PRECISION_THRESHOLDS if kind == "precision" else OVERLAP_THRESHOLDS
        y = mean.precision_curve if kind == "precision" else mean.success_curve
        label = f"{entry.tracker} [{mean.figures[key]:.3f}]"
        axes.plot(x, y, dash, color=colour, label=label, linewidth=2.4 if place == 0 else 1.4, zorder=3 - place / 100)
    if kind == "precision":
        axes.axvline(20, color="#999999", linewidth=0.8, linestyle=":")
        axes.set(xlabel="Location error threshold (pixels)", ylabel="Precision", xlim=(0, 50), ylim=(0, 1))
    else:
        axes.set(xlabel="Overlap threshold", ylabel="Success rate", xlim=(0, 1), ylim=(0, 1))
    axes.set_title(f"{kind.capitalize()} plots of OPE on {comparison.title}", fontsize=10)
    figure.legend(loc="outside lower center", ncols=2, fontsize=8.5, frameon=False, handlelength=2.4)
    return figure


def speed(comparison: Comparison, convention: Convention, styles: Styles) -> Figure | None:
    """Return precision against frames per second on a CPU; None where no tracker's speed is known."""
    rows = [row for row in comparison.published if row.convention in (convention, None)]
    points = [_measured_point(entry, convention) for entry in comparison.measured if entry.speed]
    return _scatter(comparison.title, points, rows, styles)


def average_speed(
    comparisons: list[Comparison], rows: list[Published], convention: Convention, styles: Styles
) -> Figure | None:
    """Return the same over the paper's four benchmarks: its own figures, and ours where all four were run."""
    points = []
    if {c.dataset for c in comparisons} >= set(averaged()):
        four = [c for c in comparisons if c.dataset in averaged()]
        for entry in four[0].measured:
            precision = average(four, entry.tracker, convention, "precision")
            rates = [m.speed.median for c in four for m in c.measured if m.tracker == entry.tracker and m.speed]
            if precision is not None and len(rates) == len(four):
                points.append((entry.tracker, sum(rates) / len(rates), precision))
    return _scatter("average of four benchmarks", points, rows, styles)


def attribute_radar(comparison: Comparison, convention: Convention, styles: Styles) -> Figure | None:
    """Return the AUC of the best trackers by attribute, on one axis each; None with fewer than three attributes."""
    ranked = sorted(comparison.measured, key=lambda entry: -entry.mean[convention].figures["auc"])[:_RADAR]
    found = {entry.tracker: by_attribute(comparison, entry, convention) for entry in ranked}
    names = [name for name in comparison.attributes if all(name in figures for figures in found.values())]
    if len(names) < 3:
        return None
    figure, axes = _figure(height=4.6, projection="polar")
    angles = np.linspace(0, 2 * np.pi, len(names), endpoint=False)
    for tracker, figures in found.items():
        values, (colour, dash) = [figures[name]["auc"] for name in names], styles[tracker]
        axes.plot([*angles, angles[0]], [*values, values[0]], dash, color=colour, label=tracker, linewidth=1.5)
    shown = [f"{name.replace(' ', chr(10), 1)} ({len(comparison.attributes[name])})" for name in names]
    axes.set_xticks(angles, shown, fontsize=6.5)
    axes.tick_params(axis="y", labelsize=6.5)
    axes.tick_params(axis="x", pad=9)
    axes.set_title(f"AUC by attribute on {comparison.title}", fontsize=10, pad=16)
    figure.legend(loc="outside lower center", ncols=2, fontsize=8.5, frameon=False)
    return figure


def overlap_over_time(comparison: Comparison, sequence: str, truth: FloatArray, styles: Styles) -> Figure | None:
    """Return the overlap of the best trackers with the label, frame by frame; None without a result of the sequence.

    Args:
        comparison: a benchmark with its trackers.
        sequence: name of one of its sequences.
        truth: its labels ``(n, 4)``; frames without a valid one are gaps.
        styles: colour and line style by tracker.

    Raises:
        UserError: a result cannot be read.
    """
    shown = [m for m in comparison.measured if sequence in m.files]
    if not shown:
        return None
    figure, axes = _figure(height=2.9)
    ranked = sorted(shown, key=lambda m: -m.figures["otb"][sequence]["auc"])[:_LINES]
    for place, entry in enumerate(ranked):
        boxes = read_result(entry.files[sequence], len(truth))
        with np.errstate(invalid="ignore"):
            values = np.where((truth[:, 2:] > 0).all(axis=1), overlap(boxes, truth), np.nan)
        label = f"{entry.tracker} [{entry.figures['otb'][sequence]['auc']:.3f}]"
        colour, dash = styles[entry.tracker]
        axes.plot(
            np.arange(1, len(truth) + 1), values, dash, color=colour, label=label, linewidth=1.1, zorder=3 - place / 100
        )
    axes.set(xlabel="Frame", ylabel="Overlap", xlim=(1, max(2, len(truth))), ylim=(0, 1))
    axes.set_title(f"{sequence} ({comparison.title})", fontsize=10)
    figure.legend(loc="outside lower center", ncols=2, fontsize=8.5, frameon=False)
    return figure


def as_files(figure: Figure) -> dict[str, bytes]:
    """Return the contents of a PNG, an SVG and a PDF file of a figure, by suffix; equal figures give equal files."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    files = {kind: io.BytesIO() for kind in ("png", "svg", "pdf")}
    with matplotlib.rc_context(_STYLE):
        # The layout is the same for every file.
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        figure.set_dpi(200)
        # `savefig` would draw each file twice.
        FigureCanvasAgg(figure).print_png(files["png"])
        FigureCanvasSVG(figure).print_svg(files["svg"], metadata={"Date": None})
        FigureCanvasPdf(figure).print_pdf(files["pdf"], metadata={"CreationDate": None})
    return {kind: buffer.getvalue() for kind, buffer in files.items()}


def _figure(height: float, projection: str | None = None) -> tuple[Figure, Axes]:
    import matplotlib
    from matplotlib.figure import Figure as NewFigure

    with matplotlib.rc_context(_STYLE):
        figure = NewFigure(figsize=(4.6, height), layout="constrained")
        return figure, figure.add_subplot(projection=projection)


def _measured_point(entry: Measured, convention: Convention) -> tuple[str, float, float]:
    assert entry.speed is not None
    return entry.tracker, entry.speed.median, entry.mean[convention].figures["precision"]


def _scatter(name: str, points: list[tuple[str, float, float]], rows: list[Published], styles: Styles) -> Figure | None:
    # the paper prints its own average in two tables
    printed = list({(row.tracker, row.fps_cpu, row.precision): None for row in rows if row.fps_cpu is not None})
    if not points and not printed:
        return None
    figure, axes = _figure(height=3.6)
    for tracker, fps, precision in points:
        axes.scatter(fps, precision, s=46, color=styles[tracker][0], zorder=3)
    for _, fps, precision in printed:
        axes.scatter(fps, precision, s=46, facecolors="white", edgecolors="#555555", zorder=2)
    if points:
        axes.scatter([], [], s=46, color="#333333", label="measured")
    if printed:
        axes.scatter([], [], s=46, facecolors="white", edgecolors="#555555", label=f"published ({PAPER})")
    axes.axvline(_REAL_TIME, color="#999999", linewidth=0.8, linestyle=":")
    axes.text(_REAL_TIME, 0.01, " real time", transform=axes.get_xaxis_transform(), fontsize=7.5, color="#777777")
    axes.set_xscale("log")
    axes.margins(y=0.15)
    axes.set_xticks(_FPS_TICKS, [f"{tick:g}" for tick in _FPS_TICKS], minor=False)
    axes.minorticks_off()
    every = [fps for _, fps, _ in [*points, *printed]]
    # room for the names beside the outermost points; after the ticks, which would widen it
    axes.set_xlim(min([*every, _REAL_TIME]) / 3, max([*every, _REAL_TIME]) * 2.5)
    axes.set(xlabel="Frames per second on a CPU", ylabel="Precision at 20 pixels")
    axes.set_title(f"Precision and speed, {name}", fontsize=10)
    figure.legend(loc="outside lower center", ncols=2, fontsize=8.5, frameon=False)
    _name_points(figure, axes, [(*point, "#111111") for point in points] + [(*point, "#666666") for point in printed])
    return figure


def _name_points(figure: Figure, axes: Axes, points: list[tuple[str, float, float, str]]) -> None:
    """Write names beside points, each at the first place where it covers neither a point nor another name."""
    from matplotlib.transforms import Affine2D

    figure.draw_without_rendering()
    places = [tuple(axes.transData.transform(point[1:3]) * 72 / figure.dpi) for point in points]
    area = axes.bbox.frozen().transformed(Affine2D().scale(72 / figure.dpi))
    taken = [(x - 4, y - 4, x + 4, y + 4) for x, y in places]
    for (name, fps, precision, colour), (x, y) in zip(points, places, strict=True):
        # a letter is about 0.6 of its size wide
        width, height = 0.6 * _NAME_SIZE * len(name), 1.1 * _NAME_SIZE
        for dx, dy in _NAME_OFFSETS:
            left = x + dx - width * (0.5 - 0.5 * float(np.sign(dx)))
            box = (left, y + dy - height / 2, left + width, y + dy + height / 2)
            inside = area.x0 < box[0] and box[2] < area.x1
            if inside and not any(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken):
                break
        taken.append(box)
        side = {1: "left", -1: "right", 0: "center"}[int(np.sign(dx))]
        text: dict[str, Any] = {"ha": side, "va": "center", "fontsize": _NAME_SIZE, "color": colour}
        axes.annotate(name, (fps, precision), (dx, dy), textcoords="offset points", **text)

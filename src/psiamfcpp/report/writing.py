"""A report: one page, with its tables and plots as files beside it."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import cv2

from psiamfcpp.datasets import BENCHMARKS
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.measured import CONVENTIONS
from psiamfcpp.files import write_whole
from psiamfcpp.geometry import Image
from psiamfcpp.report import page, plots, tables
from psiamfcpp.report.compare import Comparison
from psiamfcpp.report.layout import as_latex
from psiamfcpp.report.published import Published, averaged, published
from psiamfcpp.report.strips import Strip, strips, telling

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = "report.html"


def write_report(
    comparisons: list[Comparison], output: Path, percent: bool = False, sequences: Collection[str] = ()
) -> list[Path]:
    """Write ``report.html`` and, beside it, CSV and LaTeX tables, plots as PDF, PNG and SVG, and strips of frames.

    Args:
        comparisons: what `psiamfcpp.report.compare.collect` found.
        output: folder of the report; files of the same names are replaced.
        percent: show shares as percent, on the page and in LaTeX.
        sequences: those to show frames and overlaps of; by default those on which trackers differ most.

    Returns:
        The files, the page first.

    Raises:
        UserError: a file cannot be written.
    """
    if output.exists() and not output.is_dir():
        raise UserError(f"{output} is a file: give a folder for the report")
    styles = plots.colours(comparisons)
    # Published averages mean something only beside figures of the same benchmarks.
    same = {c.dataset for c in comparisons} >= set(averaged())
    averages = [row for row in published() if row.dataset == "average"] if same else []
    files: dict[str, bytes | str] = {
        "figures.csv": tables.figures_csv(comparisons),
        "sequences.csv": tables.sequences_csv(comparisons),
        "attributes.csv": tables.attributes_csv(comparisons),
        "differences.csv": tables.differences_csv(comparisons),
    }
    svgs: dict[str, bytes] = {}
    frames: dict[str, list[page.ShownStrip]] = {}
    for name, figure in _figures(comparisons, averages, styles, sequences):
        drawn = plots.as_files(figure)
        svgs[name] = drawn["svg"]
        files |= {f"{name}.{suffix}": content for suffix, content in drawn.items()}
    for c in comparisons:
        files |= _latex(c, percent)
        made = strips(c, styles, sequences)
        files |= {f"frames-{c.dataset}-{strip.sequence}.jpg": jpeg(strip.joined, 92) for strip in made}
        frames[c.dataset] = [shown_strip(strip, styles) for strip in made]
    files = {name: content for name, content in files.items() if content}
    shown = page.page(comparisons, averages, svgs, frames, files, percent)
    for name, content in files.items():
        write_whole(output / name, content)
    # last, so that a page never lacks what it links to
    write_whole(output / PAGE, shown)
    return [output / PAGE, *(output / name for name in files)]


def _figures(
    comparisons: list[Comparison],
    averages: list[Published],
    styles: dict[str, tuple[str, str]],
    sequences: Collection[str],
) -> Iterator[tuple[str, Figure]]:
    """Yield every plot by the name of its files; those for which figures are missing are left out."""
    for kind in CONVENTIONS:
        made = {f"speed-average-{kind}": plots.average_speed(comparisons, averages, kind, styles) if averages else None}
        for c in comparisons:
            made[f"precision-{c.dataset}-{kind}"] = plots.curves(c, "precision", kind, styles)
            made[f"success-{c.dataset}-{kind}"] = plots.curves(c, "success", kind, styles)
            made[f"speed-{c.dataset}-{kind}"] = plots.speed(c, kind, styles)
            made[f"attributes-{c.dataset}-{kind}"] = plots.attribute_radar(c, kind, styles)
        yield from ((name, figure) for name, figure in made.items() if figure is not None)
    for c in comparisons:
        labels = BENCHMARKS[c.dataset].read_labels(c.root, {})
        for sequence in telling(c, sequences):
            figure = plots.overlap_over_time(c, sequence, labels[sequence], styles)
            if figure is not None:
                yield f"overlap-{c.dataset}-{sequence}", figure


def _latex(c: Comparison, percent: bool) -> dict[str, bytes | str]:
    files: dict[str, bytes | str] = {}
    for kind in CONVENTIONS:
        made = {"table": tables.figures_table(c, kind, percent)}
        if len(c.measured) > 1:
            made["differences"] = tables.difference_table(c, kind)
        if c.attributes:
            made["attributes"] = tables.attribute_table(c, kind, percent)
        for name, table in made.items():
            files[f"{name}-{c.dataset}-{kind}.tex"] = as_latex(table, f"{name}-{c.dataset}-{kind}")
    return files


def shown_strip(strip: Strip, styles: dict[str, tuple[str, str]]) -> page.ShownStrip:
    """Return a strip as the page shows it."""
    frames = [(number, page.data_address("jpeg", jpeg(frame, 80))) for number, frame in strip.frames.items()]
    chips = [("label", "#ffffff"), *((name, styles[name][0]) for name in strip.trackers)]
    return page.ShownStrip(strip.sequence, chips, frames)


def jpeg(image: Image, quality: int) -> bytes:
    """Return an image ``(H, W, 3)`` uint8, BGR, as a JPEG file."""
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])

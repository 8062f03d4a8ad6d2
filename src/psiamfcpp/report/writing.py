"""A report: one page, with its tables and plots as files beside it."""

from __future__ import annotations

from pathlib import Path

import cv2

from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.measured import CONVENTIONS
from psiamfcpp.files import write_whole
from psiamfcpp.geometry import Image
from psiamfcpp.report import page, plots, tables
from psiamfcpp.report.compare import Comparison
from psiamfcpp.report.published import published
from psiamfcpp.report.strips import strips

PAGE = "report.html"


def write_report(comparisons: list[Comparison], output: Path) -> list[Path]:
    """Write ``report.html`` and, beside it, CSV and LaTeX tables, plots as PNG and SVG, and strips of frames.

    Args:
        comparisons: what `psiamfcpp.report.compare.collect` found.
        output: folder of the report; files of the same names are replaced.

    Returns:
        The files, the page first.

    Raises:
        UserError: a file cannot be written.
    """
    if output.exists() and not output.is_dir():
        raise UserError(f"{output} is a file: give a folder for the report")
    styles = plots.colours(comparisons)
    averages = [row for row in published() if row.dataset == "average"]
    files: dict[str, bytes | str] = {
        "figures.csv": tables.figures_csv(comparisons),
        "sequences.csv": tables.sequences_csv(comparisons),
        "attributes.csv": tables.attributes_csv(comparisons),
    }
    svgs: dict[str, bytes] = {}
    frames: dict[str, list[page.ShownStrip]] = {c.dataset: [] for c in comparisons}
    for kind in CONVENTIONS:
        for c in comparisons:
            files[f"table-{c.dataset}-{kind}.tex"] = tables.latex(c, kind)
        figures = {f"speed-average-{kind}": plots.average_speed(comparisons, averages, kind, styles)}
        for c in comparisons:
            figures[f"precision-{c.dataset}-{kind}"] = plots.curves(c, "precision", kind, styles)
            figures[f"success-{c.dataset}-{kind}"] = plots.curves(c, "success", kind, styles)
            figures[f"speed-{c.dataset}-{kind}"] = plots.speed(c, kind, styles)
        for name, figure in figures.items():
            if figure is not None:
                files[f"{name}.png"], svgs[name] = plots.png_and_svg(figure)
                files[f"{name}.svg"] = svgs[name]
    for c in comparisons:
        for found in strips(c, styles):
            files[f"frames-{c.dataset}-{found.sequence}.jpg"] = _jpeg(found.joined, 92)
            shown_frames = [(n, page.data_address("jpeg", _jpeg(frame, 80))) for n, frame in found.frames.items()]
            chips = [("label", "#ffffff"), *((name, styles[name][0]) for name in found.trackers)]
            frames[c.dataset].append(page.ShownStrip(found.sequence, chips, shown_frames))
    files = {name: content for name, content in files.items() if content}
    shown = page.page(comparisons, averages, svgs, frames, files)
    for name, content in files.items():
        write_whole(output / name, content)
    # last, so that a page never lacks what it links to
    write_whole(output / PAGE, shown)
    return [output / PAGE, *(output / name for name in files)]


def _jpeg(image: Image, quality: int) -> bytes:
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])

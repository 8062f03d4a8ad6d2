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
from psiamfcpp.report.strips import Strip, strips

PAGE = "report.html"


def write_report(comparisons: list[Comparison], output: Path) -> list[Path]:
    """Write ``report.html`` and, beside it, CSV and LaTeX tables, plots as PDF, PNG and SVG, and strips of frames.

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
                drawn = plots.as_files(figure)
                svgs[name] = drawn["svg"]
                files |= {f"{name}.{suffix}": content for suffix, content in drawn.items()}
    for c in comparisons:
        for found in strips(c, styles):
            files[f"frames-{c.dataset}-{found.sequence}.jpg"] = jpeg(found.joined, 92)
            frames[c.dataset].append(shown_strip(found, styles))
    files = {name: content for name, content in files.items() if content}
    shown = page.page(comparisons, averages, svgs, frames, files)
    for name, content in files.items():
        write_whole(output / name, content)
    # last, so that a page never lacks what it links to
    write_whole(output / PAGE, shown)
    return [output / PAGE, *(output / name for name in files)]


def shown_strip(strip: Strip, styles: dict[str, tuple[str, str]]) -> page.ShownStrip:
    """Return a strip as the page shows it."""
    frames = [(number, page.data_address("jpeg", jpeg(frame, 80))) for number, frame in strip.frames.items()]
    chips = [("label", "#ffffff"), *((name, styles[name][0]) for name in strip.trackers)]
    return page.ShownStrip(strip.sequence, chips, frames)


def jpeg(image: Image, quality: int) -> bytes:
    """Return an image ``(H, W, 3)`` uint8, BGR, as a JPEG file."""
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])

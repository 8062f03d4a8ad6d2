"""The report's page and the files beside it."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import pytest

from psiamfcpp.datasets.boxes import read_boxes
from psiamfcpp.errors import UserError
from psiamfcpp.report.compare import CONVENTIONS, Comparison, collect
from psiamfcpp.report.layout import as_latex
from psiamfcpp.report.page import ShownStrip, data_address, page
from psiamfcpp.report.plots import as_files, attribute_radar, curves, overlap_over_time
from psiamfcpp.report.strips import strips
from psiamfcpp.report.tables import (
    attribute_table,
    attributes_csv,
    by_attribute,
    difference_table,
    differences_csv,
    figures_csv,
    figures_table,
    rows,
    sequences_csv,
)
from psiamfcpp.report.writing import PAGE, write_report

from .conftest import OTHER

pytest.importorskip("matplotlib")

STYLES = {"blob": ("#ff0000", "-"), OTHER: ("#0000ff", "--")}


class Page(HTMLParser):
    """Tags that are open at the end, addresses that a page loads, and its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []
        self.tags: set[str] = set()
        self.handlers: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.handlers += [name for name, _ in attrs if name.startswith("on")]
        if tag not in ("meta", "input", "img", "link"):
            self.open.append(tag)
        self.loads += [value or "" for name, value in attrs if name == "src" or (tag == "link" and name == "href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def table(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


# tables


def test_rows_say_what_is_measured_and_what_is_published(comparison: Comparison) -> None:
    otb, got10k = rows(comparison, "otb"), rows(comparison, "got10k")
    assert [(row["tracker"], row["kind"]) for row in otb] == [(OTHER, "scored"), ("blob", "measured")]
    # those of the paper follow got10k, and are never shown with the other convention
    assert [(row["tracker"], row["kind"]) for row in got10k[2:]] == [
        ("SiamFC++", "published"),
        ("P-SiamFC++", "published"),
    ]
    assert got10k[3]["source"] == "Wang et al. 2022, Table 3"
    assert (got10k[3]["precision"], got10k[3]["auc"], got10k[3]["fps"]) == (0.803, None, 45.6)
    assert (otb[0]["invalid_rows"], otb[0]["sequences"], otb[0]["missing_sequences"]) == (1, 2, 0)


def test_attributes_are_means_over_their_sequences(comparison: Comparison) -> None:
    other = next(entry for entry in comparison.measured if entry.tracker == OTHER)
    found = by_attribute(comparison, other, "otb")
    assert found.keys() == {"scale variation", "aspect ratio variation"}
    one, two = (other.figures["otb"][name]["auc"] for name in ("Car1", "Car2"))
    assert one != two
    assert found["scale variation"]["auc"] == pytest.approx((one + two) / 2)
    assert found["aspect ratio variation"]["auc"] == two


def test_csv(comparison: Comparison) -> None:
    figures = table(figures_csv([comparison]))
    assert len(figures) == 2 + 2 + 2
    by = {(row["convention"], row["tracker"]): row for row in figures}
    assert by["otb", OTHER]["precision"] == "1"
    assert by["got10k", "P-SiamFC++"]["kind"] == "published"
    assert len(table(sequences_csv([comparison]))) == 2 * 2 * 2
    (row,) = (
        row
        for row in table(attributes_csv([comparison]))
        if (row["convention"], row["tracker"], row["attribute"]) == ("otb", OTHER, "aspect ratio variation")
    )
    assert row["sequences"] == "1"


def test_latex(comparison: Comparison) -> None:
    text = as_latex(figures_table(comparison, "got10k"), "x")
    assert r"K\&F\_\textless{}1\textgreater{}$^\ddagger$ & " in text
    assert r"\textbf{" in text
    assert re.search(
        r"P-SiamFC\+\+\$\^\\dagger\$ & 0\.803 & -- & -- & -- & 45\.6 & 238\.2 \\\\ % Wang et al\. 2022, Table 3", text
    )
    assert text.count(r"\begin") == text.count(r"\end") == 2
    body = [line for line in text.splitlines() if line.partition("%")[0].rstrip().endswith(r"\\")]
    assert {line.partition(" %")[0].replace(r"\&", "").count("&") for line in body} == {6}
    # under otb there are no published rows here, and so no speed on a GPU
    assert "FPS (GPU)" not in as_latex(figures_table(comparison, "otb"), "x")
    assert "& 80.3 &" in as_latex(figures_table(comparison, "got10k", percent=True), "x")


def test_columns_in_which_nothing_stands_are_left_out(comparison: Comparison) -> None:
    others = [entry for entry in comparison.measured if entry.tracker == OTHER]
    shown = figures_table(dataclasses.replace(comparison, measured=others, published=[]), "otb")
    assert list(shown.columns) == ["Tracker", "Precision", "Norm. precision", "AUC", "Success@0.5", "Source"]


def test_attributes_for_a_paper(comparison: Comparison) -> None:
    shown = attribute_table(comparison, "otb")
    assert [row.name for row in shown.rows] == ["scale variation (2)", "aspect ratio variation (1)"]
    found = by_attribute(comparison, comparison.measured[0], "otb")
    assert shown.rows[0].cells[0].text == f"{found['scale variation']['auc']:.3f}"


def test_differences_of_few_sequences_are_said_to_mean_nothing(comparison: Comparison) -> None:
    shown = difference_table(comparison, "otb")
    assert "2 sequences are too few for intervals: these differences mean nothing by themselves" in shown.caption
    ((name, cells, _),) = shown.rows
    assert (name, cells[1].text) == ("blob", "too few sequences")
    (row, *_) = table(differences_csv([comparison]))
    assert row["verdict"] == "too few sequences"


def test_a_radar_needs_three_attributes(comparison: Comparison) -> None:
    assert attribute_radar(comparison, "otb", STYLES) is None
    three = dataclasses.replace(comparison, attributes={key: ["Car1", "Car2"] for key in "abc"})
    figure = attribute_radar(three, "otb", STYLES)
    assert figure is not None
    assert [tick.get_text() for tick in figure.axes[0].get_xticklabels()] == ["a (2)", "b (2)", "c (2)"]


def test_overlap_over_time_has_gaps_where_there_is_no_label(comparison: Comparison) -> None:
    truth = read_boxes(comparison.root / "Car2" / "groundtruth_rect.txt")
    figure = overlap_over_time(comparison, "Car2", truth, STYLES)
    assert figure is not None
    lines = [line.get_ydata() for line in figure.axes[0].lines]
    assert len(lines) == 2
    assert all(len(line) == 5 and line[0] == 1 and math.isnan(line[-1]) for line in lines)


# frames


def test_strips_show_every_tracker_in_its_colour(comparison: Comparison) -> None:
    found = strips(comparison, STYLES)
    assert {strip.sequence for strip in found} == {"Car1", "Car2"}
    for strip in found:
        assert {*strip.trackers} == {"blob", OTHER}
        assert list(strip.frames) == [2, 3, 4, 5]
        for frame in strip.frames.values():
            for colour in ((0, 0, 255), (255, 0, 0)):  # BGR
                assert (frame == colour).all(axis=-1).any()
        assert strip.joined.shape[1] == 4 * 480 + 3 * 6


def test_strips_are_of_the_wanted_sequences(comparison: Comparison) -> None:
    assert [strip.sequence for strip in strips(comparison, STYLES, ["Car2", "S0101"])] == ["Car2"]


def test_an_unreadable_frame_costs_its_strip_alone(comparison: Comparison) -> None:
    (comparison.root / "Car1" / "img" / "00003.png").write_bytes(b"no image")
    assert [strip.sequence for strip in strips(comparison, STYLES)] == ["Car2"]


# the page


@pytest.mark.slow
def test_a_report_is_whole_and_needs_nothing_else(report: list[Path]) -> None:
    shown, *files = report
    output = shown.parent
    assert shown.name == PAGE
    assert {path.name for path in output.iterdir()} == {PAGE, *(path.name for path in files)}
    names = {path.name for path in files}
    assert {"figures.csv", "sequences.csv", "attributes.csv", "table-dtb70-otb.tex", "frames-dtb70-Car1.jpg"} <= names
    assert {"attributes-dtb70-otb.tex", "differences-dtb70-got10k.tex", "differences.csv"} <= names
    # the paper's averages are of other benchmarks
    assert "speed-average-otb.png" not in names
    assert "Published averages" not in shown.read_text()
    for plot in ("precision-dtb70-otb", "success-dtb70-got10k", "speed-dtb70-otb", "overlap-dtb70-Car1"):
        assert {f"{plot}.png", f"{plot}.svg", f"{plot}.pdf"} <= names
        assert cv2.imread(str(output / f"{plot}.png")) is not None
    parsed = Page(shown.read_text())
    assert parsed.open == []
    assert parsed.loads
    assert all(address.startswith("data:image/") for address in parsed.loads)
    assert "url(" not in shown.read_text()
    assert OTHER in parsed.text
    assert '<meta name="viewport" content="width=device-width' in shown.read_text()


@pytest.mark.parametrize("hostile", ['"><img src=x onerror=alert(1)>', "<script>alert(1)</script>", "{{ 7 * 7 }}"])
def test_names_from_outside_stay_text(comparison: Comparison, hostile: str) -> None:
    entry = dataclasses.replace(comparison.measured[0], tracker=hostile)
    hostile_one = dataclasses.replace(
        comparison,
        sequences=[*comparison.sequences, hostile],
        measured=[entry, *comparison.measured[1:]],
        attributes={hostile: ["Car1"]},
    )
    strip = ShownStrip(hostile, [(hostile, "#ff0000")], [(1, data_address("jpeg", b"x"))])
    parsed = Page(page([hostile_one], [], {}, {"dtb70": [strip]}, [hostile]))
    assert parsed.open == []
    assert not parsed.tags & {"script", "iframe", "object"}
    assert parsed.handlers == []
    assert all(address.startswith("data:image/") for address in parsed.loads)
    assert parsed.text.count(hostile) >= 6


def test_speeds_on_a_gpu_are_shown_where_some_were_published(comparison: Comparison) -> None:
    curves = {f"{w}-dtb70-{kind}": b"" for w in ("precision", "success") for kind in CONVENTIONS}
    text = Page(page([comparison], [], curves, {}, [])).text
    # the paper's rows on DTB70 follow got10k, so only its table has the column
    assert text.count("FPS (GPU)") == 1
    assert "238.2" in text


@pytest.mark.slow
def test_the_same_figures_give_the_same_plot(comparison: Comparison) -> None:
    first, second = (as_files(curves(comparison, "success", "otb", STYLES)) for _ in range(2))
    assert first == second
    assert first["pdf"].startswith(b"%PDF")
    assert as_files(curves(comparison, "precision", "otb", STYLES))["svg"] != first["svg"]


def test_several_benchmarks_come_with_an_overview(results: Path, dtb70: Path) -> None:
    both = collect([results / "dtb70"], {"otb100": dtb70})
    text = Page(page(both, [], {f"{w}-{c.dataset}-{k}": b"" for w in ("precision", "success") for c in both
                                for k in CONVENTIONS}, {}, [])).text  # fmt: skip
    assert "All benchmarks" in text
    assert "Tracking on DTB70, OTB100" in text


def test_the_legend_is_ranked_with_the_figure_in_brackets(comparison: Comparison) -> None:
    for kind, key in (("precision", "precision"), ("success", "auc")):
        figure = curves(comparison, kind, "otb", STYLES)
        (legend,) = figure.legends
        shown = [text.get_text() for text in legend.get_texts()]
        found = {entry.tracker: entry.mean["otb"].figures[key] for entry in comparison.measured}
        assert shown == [f"{name} [{found[name]:.3f}]" for name in sorted(found, key=lambda name: -found[name])]


def test_a_file_in_the_way_is_named(comparison: Comparison, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    with pytest.raises(UserError, match="taken is a file: give a folder"):
        write_report([comparison], tmp_path / "taken")
    assert (tmp_path / "taken").read_text() == ""

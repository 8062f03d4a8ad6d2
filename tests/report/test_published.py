"""The transcription agrees with itself as far as the tables do."""

from __future__ import annotations

import pytest

from psiamfcpp.datasets import BENCHMARKS
from psiamfcpp.report.published import averaged, pruned_layers, published

ROWS = published()
BASELINE = [row for row in ROWS if "tab:compareWbaseline" in row.source]


def test_every_row_is_there() -> None:
    assert [(row.dataset, row.source) for row in ROWS[:11]] == [("average", "Table 1, tab:precision_FPS")] * 11
    assert [(row.dataset, row.source) for row in ROWS[11:22]] == [("uavdt", "Table 2, tab:precision_FPS_deep")] * 11
    assert ROWS[22:] == BASELINE
    assert len(BASELINE) == 10
    assert all(0.5 < row.precision < 0.9 for row in ROWS)
    assert {row.dataset for row in ROWS} - {"average"} == set(averaged()) < set(BENCHMARKS)


def test_cells_that_others_are_set_beside() -> None:
    by = {(row.tracker, row.dataset, row.source.split(",")[0]): row for row in ROWS}
    assert by["KCF", "average", "Table 1"].fps_cpu == 622.5
    assert by["RACF", "average", "Table 1"].precision == 0.757
    assert by["AutoMatch", "uavdt", "Table 2"].fps_gpu == 50.0
    ours = by["P-SiamFC++", "visdrone2018", "Table 3"]
    assert (ours.precision, ours.fps_cpu, ours.fps_gpu, ours.parameters) == (0.809, 45.0, 230.5, 7490000)


@pytest.mark.parametrize("tracker", ["SiamFC++", "P-SiamFC++"])
@pytest.mark.parametrize("figure", ["precision", "fps_cpu", "fps_gpu"])
def test_printed_averages_are_those_of_the_four_benchmarks(tracker: str, figure: str) -> None:
    by = {row.dataset: getattr(row, figure) for row in BASELINE if row.tracker == tracker}
    # The table prints one decimal of a percentage, or of a speed; what it averaged had more.
    step = 0.001 if figure == "precision" else 0.1
    assert sum(by[name] for name in averaged()) / 4 == pytest.approx(by["average"], abs=step)


def test_tables_agree_on_the_tracker_of_the_paper() -> None:
    ours = [row for row in ROWS if row.tracker == "P-SiamFC++"]
    average, deep, *_, last = ours
    (uavdt,) = (row for row in ours[2:] if row.dataset == "uavdt")
    assert (average.precision, average.fps_cpu) == (last.precision, last.fps_cpu) == (0.788, 46.1)
    assert (deep.precision, deep.fps_gpu) == (uavdt.precision, uavdt.fps_gpu)


def test_pruning_ratios() -> None:
    layers = {layer.layer: layer.precision for layer in pruned_layers()}
    assert len(layers) == 9
    assert all(list(row) == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8] for row in layers.values())
    # the highest of each row, which the paper prints bold; two of L3 (Head) are equal
    best = [max(row.values()) for row in layers.values()]
    assert best == [0.798, 0.811, 0.797, 0.817, 0.801, 0.789, 0.806, 0.817, 0.81]
    assert [max(row, key=row.__getitem__) for row in layers.values()] == [0.3, 0.4, 0.5, 0.2, 0.2, 0.6, 0.7, 0.2, 0.3]
    assert {layer.dataset for layer in pruned_layers()} == {"dtb70"}


def test_conventions_are_told_where_they_are_known() -> None:
    told = {(row.tracker, row.source.split(",")[0]): row.convention for row in ROWS}
    assert told["KCF", "Table 1"] == told["RACF", "Table 1"] == "otb"
    assert {kind for (tracker, _), kind in told.items() if tracker.endswith("SiamFC++")} == {"got10k"}
    assert told["TransT", "Table 2"] is told["HiFT", "Table 2"] is None

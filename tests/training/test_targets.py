from __future__ import annotations

import math

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from psiamfcpp.training.targets import Targets, assign

# At 303 pixels, cells stand at 87, 95, ..., 215; the middle one, number 8, at 151.


def of(*boxes: tuple[float, float, float, float], present: bool = True) -> Targets:
    return assign(torch.tensor(boxes), torch.tensor([present] * len(boxes)), 303, 17)


@pytest.fixture
def wide() -> Targets:
    return of((131, 141, 171, 161))


def test_cells_inside_the_box_are_positive(wide: Targets):
    rows, columns = wide.positive[0].nonzero(as_tuple=True)
    assert sorted(set(rows.tolist())) == [7, 8, 9]
    assert sorted(set(columns.tolist())) == [6, 7, 8, 9, 10]
    assert wide.positive.sum() == 15


@pytest.mark.parametrize(
    ("row", "column", "distances", "centerness"),
    [
        (8, 8, [20, 10, 20, 10], 1.0),
        (8, 7, [12, 10, 28, 10], math.sqrt(12 / 28)),
        (8, 9, [28, 10, 12, 10], math.sqrt(12 / 28)),
        (7, 8, [20, 2, 20, 18], math.sqrt(2 / 18)),
        (9, 6, [4, 18, 36, 2], math.sqrt(4 / 36 * 2 / 18)),
    ],
)
def test_distances_and_centerness(wide: Targets, row: int, column: int, distances: list[float], centerness: float):
    assert wide.distances[0, row, column].tolist() == distances
    assert wide.centerness[0, row, column].item() == pytest.approx(centerness)


def test_centerness_is_zero_where_not_positive(wide: Targets):
    assert (wide.centerness[~wide.positive] == 0).all()
    assert (wide.centerness[wide.positive] > 0).all()


def test_sides_are_not_inside():
    assert of((143, 143, 159, 159)).positive.sum() == 1


@given(
    st.floats(87, 215, width=32),
    st.floats(87, 215, width=32),
    st.floats(1, 7, width=32),
    st.floats(1, 7, width=32),
)
def test_boxes_smaller_than_a_stride_get_the_nearest_cell(cx: float, cy: float, w: float, h: float):
    targets = of((cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2))
    assert targets.positive.any()
    assert (targets.distances >= 0.5).all()
    # Halfway between two cells both are nearest.
    assume(all(abs((v - 87) % 8 - 4) > 1e-3 for v in (cx, cy)))
    assert targets.positive[0].nonzero().tolist() == [[round((cy - 87) / 8), round((cx - 87) / 8)]]


def test_a_box_between_four_cells():
    targets = of((145, 145, 149, 149))
    assert targets.positive[0].nonzero().tolist() == [[7, 7], [7, 8], [8, 7], [8, 8]]
    assert targets.distances[0, 7, 7].tolist() == [0.5, 0.5, 6, 6]


def test_a_thin_box_between_two_columns():
    assert of((144, 100, 148, 203)).positive[0].nonzero().tolist() == [[8, 7]]


@pytest.mark.parametrize(("centre", "cells"), [(222.0, [[16, 16]]), (80.0, [[0, 0]]), (223.0, []), (240.0, [])])
def test_boxes_beyond_the_last_cell_count_within_a_stride(centre: float, cells: list[list[int]]):
    targets = of((centre - 3, centre - 3, centre + 3, centre + 3))
    assert targets.positive[0].nonzero().tolist() == cells


@pytest.mark.parametrize("box", [(131, 141, 171, 161), (145, 145, 149, 149)])
def test_absent_targets_have_no_cell(box):
    targets = of(box, present=False)
    assert not targets.positive.any()
    assert not targets.centerness.any()


def test_a_batch_is_assigned_box_by_box():
    boxes = ((131.0, 141.0, 171.0, 161.0), (145.0, 145.0, 148.0, 149.0), (240.0, 240.0, 250.0, 250.0))
    together = of(*boxes)
    for i, box in enumerate(boxes):
        alone = of(box)
        for name in ("positive", "centerness", "distances"):
            assert torch.equal(getattr(together, name)[i], getattr(alone, name)[0])

"""What counts as a difference between graphs and network."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("onnx")

from psiamfcpp.errors import UserError
from psiamfcpp.export.parity import Answer, Difference, compare


def answer(peak: tuple[int, int], box: tuple[float, ...] = (1, 1, 10, 10)) -> Answer:
    scores = np.full((3, 3), 0.1, np.float32)
    scores[peak] = 0.9
    return scores, np.tile(np.array(box, np.float32), (3, 3, 1))


def test_equal_answers_do_not_differ() -> None:
    assert compare([answer((1, 1))], [answer((1, 1))]) == Difference(0.0, 0.0, 1.0)


def test_only_cells_near_the_peak_count_for_boxes() -> None:
    scores, boxes = answer((1, 1))
    boxes[0, 0] += 100
    assert compare([answer((1, 1))], [(scores, boxes)]).boxes == 0
    boxes[1, 1, 0] += 2
    found = compare([answer((1, 1))], [(scores, boxes)])
    assert found.boxes == 2
    assert 0.5 < found.overlap < 1


def test_scores_without_a_peak_show_nothing() -> None:
    flat = (np.zeros((3, 3), np.float32), np.zeros((3, 3, 4), np.float32))
    with pytest.raises(UserError, match="alike everywhere in a crop: train it before"):
        compare([flat], [flat])


@pytest.mark.parametrize(
    ("difference", "int8", "message"),
    [
        (Difference(2e-3, 0.0, 1.0), False, "are not the network: scores differ by up to 0.002"),
        (Difference(0.0, 0.06, 1.0), False, "16 bits"),
        (Difference(0.0, 0.0, 0.89), True, "overlap by 0.890"),
        (Difference(0.0, 0.0, float("nan")), True, "overlap by nan"),
        (Difference(float("nan"), 0.0, 1.0), False, "are not the network"),
    ],
)
def test_too_large_differences_are_refused(difference: Difference, int8: bool, message: str) -> None:
    with pytest.raises(UserError, match=message):
        difference.check(int8)


def test_roundings_are_accepted() -> None:
    Difference(1e-4, 0.01, 0.99).check(int8=False)
    Difference(0.05, 3.0, 0.95).check(int8=True)

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from psiamfcpp.datasets import Sequence

NAN, INF = np.nan, np.inf


@pytest.mark.parametrize(
    ("box", "min_side", "usable"),
    [
        ((1, 2, 3, 4), 0, True),
        ((-5, -5, 0.1, 0.1), 0, True),
        ((0, 0, 0, 0), 0, False),
        ((1, 2, 0, 4), 0, False),
        ((1, 2, 3, -4), 0, False),
        ((NAN, NAN, NAN, NAN), 0, False),
        ((NAN, 2, 3, 4), 0, False),
        ((1, 2, 3, NAN), 0, False),
        ((1, 2, INF, 4), 0, False),
        ((1, 2, 5, 5), 5, True),
        ((1, 2, 100, 4.9), 5, False),
    ],
)
def test_which_labels_are_usable(box: tuple[float, ...], min_side: float, usable: bool):
    boxes = np.array([(NAN,) * 4, box, (0, 0, 9, 9)])
    sequence = Sequence("car", [Path(f"{k}.jpg") for k in range(3)], boxes)
    with np.errstate(all="raise"):
        assert sequence.usable(min_side).tolist() == ([1, 2] if usable else [2])

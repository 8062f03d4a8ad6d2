"""Ranks image by image: the file, and the stability of the order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiamfcpp.errors import UserError
from psiamfcpp.pruning.ranking import Looked
from psiamfcpp.pruning.record import load_looks, rank_correlation, save_looks, stability


def looked(*images: list[int]) -> dict[str, Looked]:
    return {"a": Looked((np.array(images, np.int16), np.array(images, np.int16) // 2), (9, 4))}


def test_what_is_saved_is_loaded_as_one_batch(tmp_path: Path) -> None:
    path = tmp_path / "looks.npz"
    assert load_looks(path, "key") == []
    save_looks(path, "key", [looked([1, 2], [3, 4]), looked([5, 6])])
    (batch,) = load_looks(path, "key")
    assert batch["a"].sizes == (9, 4)
    assert [r.tolist() for r in batch["a"].ranks] == [[[1, 2], [3, 4], [5, 6]], [[0, 1], [1, 2], [2, 3]]]
    assert list(tmp_path.iterdir()) == [path]


def test_a_record_of_something_else_or_damaged_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "looks.npz"
    save_looks(path, "key", [looked([1, 2])])
    with pytest.raises(UserError, match="another model"):
        load_looks(path, "other")
    for damage in (path.read_bytes()[:100], b"", b"PK nonsense"):
        path.write_bytes(damage)
        with pytest.raises(UserError, match="remove it to begin anew"):
            load_looks(path, "key")


def test_stability_compares_even_and_odd_images_of_growing_numbers() -> None:
    # Even and odd images agree among the first ten, and are opposed from then on.
    alike, against = [1, 2, 3], [9, 5, 1]
    images = [alike] * 10 + [alike, against] * 10
    rows = stability([looked(*images)])["a"]
    assert [row["images"] for row in rows] == [10, 20, 30]
    assert [row["correlation"] for row in rows] == pytest.approx([1, -1, -1])
    assert stability([looked([2, 2], [2, 2])])["a"] == [{"images": 2, "correlation": None}]


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=2))
def test_rank_correlation_is_spearmans(pairs: list[tuple[int, int]]) -> None:
    # Here, since its import takes a second.
    from scipy.stats import spearmanr

    a, b = np.array(pairs, dtype=float).T
    found = rank_correlation(a, b)
    if len(set(a)) == 1 or len(set(b)) == 1:
        assert found is None
    else:
        assert found == pytest.approx(spearmanr(a, b).statistic)

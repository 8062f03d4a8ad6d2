from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from psiamfcpp.datasets.boxes import find_files, read_boxes, write_boxes
from psiamfcpp.errors import UserError


@pytest.mark.parametrize("text", ["1,2,3,4", "1\t2\t3\t4\n", " 1 2  3 4 \n\n", "1, 2, 3, 4\r\n"])
def test_boxes_separated_by_commas_tabs_or_blanks(tmp_path: Path, text: str):
    path = tmp_path / "boxes.txt"
    path.write_text(text)
    assert read_boxes(path).tolist() == [[1, 2, 3, 4]]


def test_boxes_of_nan_stay_nan(tmp_path: Path):
    path = tmp_path / "boxes.txt"
    path.write_text("NaN,NaN,NaN,NaN\n1.5,2,3,4\n")
    np.testing.assert_equal(read_boxes(path), [[np.nan] * 4, [1.5, 2, 3, 4]])


@pytest.mark.parametrize(
    "word", ["NaN", "nan", "NAN", "-nan", "+NaN", "nan(0x8000)", "-nan(ind)", "1.#QNAN", "-1.#IND", "1.#qnan00"]
)
def test_a_nan_in_any_spelling(tmp_path: Path, word: str):
    path = tmp_path / "boxes.txt"
    path.write_text(f"1,2,{word},4\n{word}\t{word}\t{word}\t{word}\n")
    np.testing.assert_equal(read_boxes(path), [[1, 2, np.nan, 4], [np.nan] * 4])


def test_a_byte_order_mark_is_no_number(tmp_path: Path):
    path = tmp_path / "boxes.txt"
    path.write_text("1,2,3,4\r\n", "utf-8-sig")
    assert read_boxes(path).tolist() == [[1, 2, 3, 4]]


@pytest.mark.parametrize(
    "text", ["1,2,3\n", "1,2\n3,4\n", "1,2,3,4\n1,2\n", "1,2,3,4,5,6,7,8\n", "1,2,three,4\n", "1,2,nano,4\n"]
)
def test_lines_that_do_not_hold_four_numbers(tmp_path: Path, text: str):
    path = tmp_path / "boxes.txt"
    path.write_text(text)
    with pytest.raises(UserError, match=r"boxes\.txt cannot be read: line \d is '1,2"):
        read_boxes(path)


def test_boxes_missing(tmp_path: Path):
    with pytest.raises(UserError, match=r"none\.txt does not exist"):
        read_boxes(tmp_path / "none.txt")


def test_a_file_cut_within_a_line_names_the_line(tmp_path: Path):
    path = tmp_path / "boxes.txt"
    path.write_text("1,2,3,4\n5,6,7,8\n9,1")
    with pytest.raises(UserError, match=r"boxes\.txt cannot be read: line 3 is '9,1'.* was the file cut"):
        read_boxes(path)


@pytest.mark.parametrize(
    ("text", "cut"),
    [
        ("x,y,w,h\n1,2,3,4\n", False),
        ("1,2,3,4,5,6,7,8\n", False),
        ("7,1,2,3,4\n", False),
        ("1,2\n3,4,5,6\n", False),
        ("1,2,3,4\n1,2\n", True),
    ],
    ids=["header", "polygon", "frame number", "first line short", "last line short"],
)
def test_only_a_short_last_line_looks_like_a_cut_file(tmp_path: Path, text: str, cut: bool):
    path = tmp_path / "boxes.txt"
    path.write_text(text)
    with pytest.raises(UserError, match="but four numbers are expected") as caught:
        read_boxes(path)
    assert ("cut" in str(caught.value)) is cut


@pytest.mark.slow
@given(
    arrays(np.float64, st.tuples(st.integers(0, 5), st.just(4)), elements=st.floats(-1e6, 1e6) | st.just(np.nan)),
    st.integers(0, 6),
)
def test_written_boxes_read_back_to_the_last_decimal(boxes: np.ndarray, decimals: int):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "made" / "boxes.txt"
        write_boxes(path, boxes, decimals)
        np.testing.assert_allclose(read_boxes(path), boxes, rtol=0, atol=0.5 * 10**-decimals + 1e-9)


def test_hidden_names_are_passed_over_but_not_a_hidden_root(tmp_path: Path):
    root = tmp_path / ".cache"
    for name in ("b.txt", "a.txt", "._a.txt", "c/a.txt", ".checkpoints/a.txt", "c/._a.txt", "a.csv"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    assert find_files(root, "*.txt") == [root / "a.txt", root / "b.txt"]
    assert find_files(root, "**/a.txt") == [root / "a.txt", root / "c" / "a.txt"]

"""Files of MATLAB, against SciPy's writer, and damaged."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiamfcpp.evaluation.matlab import read_variable

matlab = pytest.importorskip("scipy.io")


def written(value: Any, packed: bool = True, name: str = "results") -> bytes:
    content = io.BytesIO()
    matlab.savemat(content, {"first": np.ones(3), name: value}, do_compression=packed)
    return content.getvalue()


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"])
def test_numbers_of_every_kind(kind: str, packed: bool) -> None:
    values = np.arange(12).reshape(3, 4).astype(kind)
    found = read_variable(written(values, packed), "results")
    assert found.dtype.kind == np.dtype(kind).kind
    np.testing.assert_array_equal(found, values)


def test_structs_and_cells_give_their_first_element() -> None:
    inner = {
        "type": "rect",
        "res": np.array([[1.5, 2, 3, 4]]),
        "len": 1.0,
        "name": "S\u00fcd",
        "empty": np.empty((0, 4)),
    }
    cell = np.empty((1, 2), object)
    cell[0, 0], cell[0, 1] = inner, {"type": "other"}
    for value in (inner, cell):
        found = read_variable(written(value), "results")
        assert (found["type"], found["name"], found["empty"]) == ("rect", "S\u00fcd", None)
        assert found["res"].tolist() == [[1.5, 2, 3, 4]]


def test_what_is_not_there_or_no_file_of_matlab() -> None:
    with pytest.raises(ValueError, match="holds no variable results"):
        read_variable(written(np.ones(2), name="other"), "results")
    for content in (b"", b"x" * 200, written(np.ones(2))[:126]):
        with pytest.raises(ValueError, match="no MATLAB file of level 5"):
            read_variable(content, "results")


def test_what_grows_without_bound_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    content = written(np.zeros((1000, 1000)))
    monkeypatch.setattr("psiamfcpp.evaluation.matlab._MOST_BYTES", 2**20)
    with pytest.raises(ValueError, match=r"grows beyond 1,048,576 bytes"):
        read_variable(content, "results")


def test_cells_in_cells_without_end_are_refused() -> None:
    value: Any = np.ones(1)
    for _ in range(20):
        outer = np.empty((1, 1), object)
        outer[0, 0] = value
        value = outer
    with pytest.raises(ValueError, match="nested too deep"):
        read_variable(written(value), "results")


WHOLE = [written({"type": "rect", "res": np.arange(8.0).reshape(2, 4)}, packed) for packed in (True, False)]


@given(
    st.sampled_from(WHOLE), st.lists(st.tuples(st.integers(120, 600), st.binary(min_size=1, max_size=4)), max_size=4)
)
def test_damaged_files_are_read_or_refused(content: bytes, changes: list[tuple[int, bytes]]) -> None:
    data = bytearray(content)
    for at, new in changes:
        data[at : at + len(new)] = new
    for length in (len(data), len(data) // 2):
        try:
            found = read_variable(bytes(data[:length]), "results")
        except ValueError:
            continue
        assert found is None or isinstance(found, (dict, np.ndarray, str))

from __future__ import annotations

import pytest

from psiamfcpp.datasets import stills
from psiamfcpp.errors import UserError

HEADER = "image,x,y,w,h,label,source\n"


def test_one_sequence_an_object(lay):
    root = lay({"boxes.csv": HEADER + "a.jpg,1,2,3.5,4,car,visdrone\na.jpg,5,6,7,8,boat,seadrones\n"})
    car, boat = stills.read(root)
    assert car.frames == boat.frames == [root / "images" / "a.jpg"]
    assert car.boxes.tolist() == [[1, 2, 3.5, 4]]
    assert boat.boxes.tolist() == [[5, 6, 7, 8]]
    assert (car.source, boat.source) == ("visdrone", "seadrones")
    assert car.name != boat.name


def test_columns_in_any_order(lay):
    root = lay({"boxes.csv": "h,w,y,x,source,label,image\n4,3,2,1,s,l,a.png\n"})
    (sequence,) = stills.read(root)
    assert sequence.boxes.tolist() == [[1, 2, 3, 4]]


def test_missing_table(lay):
    with pytest.raises(UserError, match=r"boxes\.csv is missing; expected layout: <root>/images"):
        stills.read(lay({}))


@pytest.mark.parametrize("row", ["a.jpg,1,2,three,4,car,s\n", "a.jpg,1,2\n"])
def test_junk_row_is_named_by_its_line(lay, row: str):
    root = lay({"boxes.csv": HEADER + "a.jpg,1,2,3,4,car,s\n" + row})
    with pytest.raises(UserError, match=r"boxes\.csv line 3 is not a labelled box"):
        stills.read(root)


def test_missing_column(lay):
    root = lay({"boxes.csv": "image,x,y,w,h,label\na.jpg,1,2,3,4,car\n"})
    with pytest.raises(UserError, match=r"boxes\.csv line 2 .*'source'"):
        stills.read(root)

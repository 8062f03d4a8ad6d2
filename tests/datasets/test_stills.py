from __future__ import annotations

import pytest

from psiamfcpp.datasets import stills
from psiamfcpp.errors import UserError

HEADER = "image,x,y,w,h,label,source\n"


IMAGES = ("images/a.jpg", "images/a.png")


@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_one_sequence_an_object(lay, mark: str):
    text = mark + HEADER + "a.jpg,1,2,3.5,4,car,visdrone\na.jpg,5,6,7,8,boat,seadrones\n"
    root = lay({"boxes.csv": text}, IMAGES)
    car, boat = stills.read(root)
    assert car.frames == boat.frames == [root / "images" / "a.jpg"]
    assert car.boxes.tolist() == [[1, 2, 3.5, 4]]
    assert boat.boxes.tolist() == [[5, 6, 7, 8]]
    assert (car.source, boat.source) == ("visdrone", "seadrones")
    assert car.name != boat.name


def test_columns_in_any_order(lay):
    root = lay({"boxes.csv": "h,w,y,x,source,label,image\n4,3,2,1,s,l,a.png\n"}, IMAGES)
    (sequence,) = stills.read(root)
    assert sequence.boxes.tolist() == [[1, 2, 3, 4]]


def test_missing_table(lay):
    with pytest.raises(UserError, match=r"boxes\.csv is missing; expected layout: <root>/images"):
        stills.read(lay({}))


@pytest.mark.parametrize("row", ["a.jpg,1,2,three,4,car,s\n", "a.jpg,1,2\n"])
def test_junk_row_is_named_by_its_line(lay, row: str):
    root = lay({"boxes.csv": HEADER + "a.jpg,1,2,3,4,car,s\n" + row}, IMAGES)
    with pytest.raises(UserError, match=r"boxes\.csv line 3 is not a labelled box"):
        stills.read(root)


def test_missing_column(lay):
    root = lay({"boxes.csv": "image,x,y,w,h,label\na.jpg,1,2,3,4,car\n"}, IMAGES)
    with pytest.raises(UserError, match=r"boxes\.csv line 2 .*'source'"):
        stills.read(root)


ODD = HEADER + "a.jpg,1,2,3,4,car,s\nb.jpg,1,2,3,4,car,s\na.jpg,1,2,x,4,car,s\na.png,1,2,3,4,car,s\n"


def test_a_missing_image_is_found_at_the_start(lay):
    with pytest.raises(UserError, match=r"images/b\.jpg does not exist, which .*boxes\.csv line 3 names"):
        stills.read(lay({"boxes.csv": ODD}, IMAGES))


def test_odd_rows_can_be_left_out(lay):
    left_out: list[str] = []
    found = stills.read(lay({"boxes.csv": ODD}, IMAGES), left_out)
    assert [sequence.name for sequence in found] == ["a.jpg#2", "a.png#5"]
    missing, no_box = left_out
    assert "b.jpg does not exist" in missing
    assert "line 4 is not a labelled box" in no_box

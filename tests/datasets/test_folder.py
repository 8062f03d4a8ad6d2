from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from psiamfcpp.datasets import folder
from psiamfcpp.errors import UserError

from .conftest import level, write_video


def test_sequences_at_any_depth(lay):
    root = lay(
        {
            "b/deep/car1_s/groundtruth_rect.txt": "1,2,3,4\n5,6,7,8\n",
            "a/boat_2/groundtruth_rect.txt": "9,9,9,9\n",
        },
        empty=("b/deep/car1_s/img/0002.jpg", "b/deep/car1_s/img/0001.jpg", "a/boat_2/img/1.PNG"),
    )
    boat, car = folder.read(root)
    assert (boat.name, boat.source, car.name, car.source) == ("boat_2", "boat", "car1_s", "car")
    assert [p.name for p in car.frames] == ["0001.jpg", "0002.jpg"]
    assert car.boxes.tolist() == [[1, 2, 3, 4], [5, 6, 7, 8]]
    assert boat.frames == [root / "a/boat_2/img/1.PNG"]


@pytest.mark.parametrize("text", ["1,2,3,4", "1\t2\t3\t4\n", " 1 2  3 4 \n\n", "1, 2, 3, 4\r\n"])
def test_boxes_parted_by_commas_tabs_or_blanks(tmp_path: Path, text: str):
    path = tmp_path / "boxes.txt"
    path.write_text(text)
    assert folder.read_boxes(path).tolist() == [[1, 2, 3, 4]]


def test_boxes_of_nan_stay_nan(tmp_path: Path):
    path = tmp_path / "boxes.txt"
    path.write_text("NaN,NaN,NaN,NaN\n1.5,2,3,4\n")
    np.testing.assert_equal(folder.read_boxes(path), [[np.nan] * 4, [1.5, 2, 3, 4]])


@pytest.mark.parametrize(
    "word", ["NaN", "nan", "NAN", "-nan", "+NaN", "nan(0x8000)", "-nan(ind)", "1.#QNAN", "-1.#IND", "1.#qnan00"]
)
def test_a_nan_in_any_spelling(tmp_path: Path, word: str):
    path = tmp_path / "boxes.txt"
    path.write_text(f"1,2,{word},4\n{word}\t{word}\t{word}\t{word}\n")
    np.testing.assert_equal(folder.read_boxes(path), [[1, 2, np.nan, 4], [np.nan] * 4])


def test_a_byte_order_mark_is_no_number(tmp_path: Path):
    path = tmp_path / "boxes.txt"
    path.write_text("1,2,3,4\r\n", "utf-8-sig")
    assert folder.read_boxes(path).tolist() == [[1, 2, 3, 4]]


@pytest.mark.parametrize(
    "text", ["1,2,3\n", "1,2\n3,4\n", "1,2,3,4\n1,2\n", "1,2,3,4,5,6,7,8\n", "1,2,three,4\n", "1,2,nano,4\n"]
)
def test_boxes_that_are_not_four_numbers_a_line(tmp_path: Path, text: str):
    path = tmp_path / "boxes.txt"
    path.write_text(text)
    with pytest.raises(UserError, match=r"boxes\.txt (cannot be read|do not have four numbers)"):
        folder.read_boxes(path)


def test_boxes_missing(tmp_path: Path):
    with pytest.raises(UserError, match=r"none\.txt cannot be read"):
        folder.read_boxes(tmp_path / "none.txt")


def test_another_number_of_boxes_than_of_images(lay):
    root = lay({"car/groundtruth_rect.txt": "1,2,3,4\n5,6,7,8\n"}, empty=("car/img/1.jpg",))
    with pytest.raises(UserError, match="car has 1 images but 2 boxes"):
        folder.read(root)


def test_one_name_twice_is_refused_where_labels_go_by_name(lay):
    root = lay({"a/car/groundtruth_rect.txt": "1,2,3,4\n", "b/car/groundtruth_rect.txt": "1,2,3,4\n"})
    with pytest.raises(UserError, match=r"a/car and .*b/car have one name"):
        folder.label_files(root)


def test_a_file_cut_within_a_line_names_the_line(tmp_path: Path):
    path = tmp_path / "boxes.txt"
    path.write_text("1,2,3,4\n5,6,7,8\n9,1")
    with pytest.raises(UserError, match=r"boxes\.txt cannot be read: line 3 is '9,1'.* was the file cut"):
        folder.read_boxes(path)


def test_a_video_in_place_of_images(lay):
    root = lay({"car/groundtruth_rect.txt": "1,2,3,4\n5,6,7,8\n9,9,9,9\n"})
    write_video(root / "car" / "video.mp4", 3)
    (car,) = folder.read(root)
    assert [level(car.frame(i)) for i in range(3)] == [0, 1, 2]
    assert car.boxes.shape == (3, 4)


def test_a_video_with_another_number_of_frames(lay):
    root = lay({"car/groundtruth_rect.txt": "1,2,3,4\n"})
    write_video(root / "car" / "video.mp4", 3)
    with pytest.raises(UserError, match="car has 3 images but 1 boxes"):
        folder.read(root)


def test_images_go_before_a_video(lay):
    root = lay({"car/groundtruth_rect.txt": "1,2,3,4\n"}, empty=("car/img/1.jpg", "car/video.mp4"))
    assert folder.read(root)[0].frames == [root / "car/img/1.jpg"]

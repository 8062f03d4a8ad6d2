from __future__ import annotations

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


def test_another_number_of_boxes_than_of_images(lay):
    root = lay({"car/groundtruth_rect.txt": "1,2,3,4\n5,6,7,8\n"}, empty=("car/img/1.jpg",))
    with pytest.raises(UserError, match="car has 1 images but 2 boxes"):
        folder.read(root)


def test_one_name_twice_is_refused_where_labels_go_by_name(lay):
    root = lay({"a/car/groundtruth_rect.txt": "1,2,3,4\n", "b/car/groundtruth_rect.txt": "1,2,3,4\n"})
    with pytest.raises(UserError, match=r"a/car and .*b/car have one name"):
        folder.label_files(root)


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

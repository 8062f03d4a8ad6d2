from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from psiamfcpp.datasets.frames import FrameStore, VideoFrame, read_frame, video_frames
from psiamfcpp.errors import UserError
from psiamfcpp.images import read_image

from .conftest import level, write_video


@pytest.fixture
def video(tmp_path: Path) -> Path:
    return write_video(tmp_path / "grey.mp4", 12)


def test_a_video_has_a_reference_a_frame(video: Path):
    frames = video_frames(video)
    assert frames == [VideoFrame(video, number) for number in range(12)]


@pytest.mark.parametrize("order", [range(12), [3, 4, 9], [5, 5, 5], [11, 0, 6, 1]])
def test_frames_of_a_video_come_in_any_order(video: Path, order):
    assert [level(read_frame(VideoFrame(video, number))) for number in order] == list(order)


def test_two_videos_in_turn(video: Path, tmp_path: Path):
    other = write_video(tmp_path / "other.mp4", 12, start=7)
    read = [level(read_frame(VideoFrame(path, number))) for number in range(4) for path in (video, other)]
    assert read == [0, 7, 1, 8, 2, 9, 3, 10]


def test_an_image_file_is_a_frame_too(tmp_path: Path):
    path = tmp_path / "a.png"
    path.write_bytes(_png(30))
    assert np.array_equal(read_frame(path), read_image(path))
    assert np.array_equal(FrameStore(tmp_path / "store").read(path), read_image(path))


@pytest.mark.parametrize("read", [read_frame, lambda frame: FrameStore().read(frame)], ids=["read_frame", "store"])
def test_a_frame_behind_the_end_is_named(video: Path, read):
    with pytest.raises(UserError, match=r"grey\.mp4 ends before frame 12"):
        read(VideoFrame(video, 12))


@pytest.mark.parametrize(
    "read", [read_frame, lambda frame: FrameStore().read(frame), lambda frame: video_frames(frame.video)]
)
def test_a_missing_video_and_one_that_is_none(tmp_path: Path, read):
    with pytest.raises(UserError, match=r"gone\.mp4 (does not exist|cannot be read)"):
        read(VideoFrame(tmp_path / "gone.mp4", 0))
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(UserError, match=r"text\.mp4 cannot be read"):
        read(VideoFrame(tmp_path / "text.mp4", 0))


def test_a_store_gives_the_frames_of_the_video(video: Path, tmp_path: Path):
    store = FrameStore(tmp_path / "store")
    for number in (7, 2, 11):
        stored, direct = store.read(VideoFrame(video, number)), read_frame(VideoFrame(video, number))
        assert stored.shape == direct.shape
        assert np.abs(stored.astype(int) - direct).mean() < 2


def test_a_store_decodes_a_video_once(video: Path, tmp_path: Path):
    before = FrameStore(tmp_path / "store").read(VideoFrame(video, 3))
    facts = video.stat()
    # The same size and time, but no video any more: whoever decodes it again fails.
    video.write_bytes(bytes(facts.st_size))
    import os

    os.utime(video, ns=(facts.st_atime_ns, facts.st_mtime_ns))
    assert np.array_equal(FrameStore(tmp_path / "store").read(VideoFrame(video, 3)), before)


def test_another_video_of_the_same_name_is_decoded_anew(video: Path, tmp_path: Path):
    store = FrameStore(tmp_path / "store")
    assert level(store.read(VideoFrame(video, 3))) == 3
    write_video(video, 14, start=5)
    assert level(store.read(VideoFrame(video, 3))) == 8


def test_a_store_of_its_own_goes_with_it(video: Path):
    store = FrameStore()
    copy = pickle.loads(pickle.dumps(store))
    assert level(copy.read(VideoFrame(video, 4))) == 4
    folder = store.folder
    del copy
    assert folder.is_dir(), "a loader process that ends leaves the frames to the others"
    del store
    assert not folder.exists()


def test_a_store_that_cannot_be_written(video: Path, tmp_path: Path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match=r"frames cannot be stored in .*file"):
        FrameStore(tmp_path / "file").read(VideoFrame(video, 0))


def _png(shade: int) -> bytes:
    import cv2

    return cv2.imencode(".png", np.full((4, 6, 3), shade, np.uint8))[1].tobytes()

from __future__ import annotations

import base64
from pathlib import Path

import cv2
import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.trackers.adapters.trax_worker import ProtocolError
from psiamfcpp.trackers.trax.images import ImageSender, decode_image

FRAME = np.random.default_rng(0).integers(0, 256, (7, 9, 3), np.uint8)


@pytest.mark.parametrize("accepted", [["memory"], ["data"], ["buffer"], ["path"], ["url"], [], ["path", "memory"]])
def test_frames_survive_the_wire(tmp_path: Path, accepted: list[str]) -> None:
    text = ImageSender(accepted, tmp_path).text(FRAME)
    assert (decode_image(text) == FRAME).all()


def test_memory_goes_before_files_and_files_are_the_default(tmp_path: Path) -> None:
    assert ImageSender(["path", "url", "memory"], tmp_path).text(FRAME).startswith("image:9;7;rgb;")
    assert ImageSender([], tmp_path).text(FRAME).startswith(f"file://{tmp_path}")
    with pytest.raises(ProtocolError, match="takes images by hologram"):
        ImageSender(["hologram"], tmp_path)


def test_the_two_latest_files_are_kept(tmp_path: Path) -> None:
    sender = ImageSender(["path"], tmp_path)
    texts = [sender.text(FRAME) for _ in range(5)]
    assert sorted(f"file://{path}" for path in tmp_path.iterdir()) == texts[-2:]


@pytest.mark.parametrize("frame", [FRAME[..., 0], FRAME.astype(float), FRAME[:0], None, "frame"])
def test_what_is_no_frame_is_refused(tmp_path: Path, frame: object) -> None:
    with pytest.raises(UserError, match="frame is no image"):
        ImageSender([], tmp_path).text(frame)  # type: ignore[arg-type]


def test_encoded_data_in_every_spelling() -> None:
    data = base64.b64encode(bytes(cv2.imencode(".png", FRAME)[1])).decode()
    # the specification, RFC 2397, and the reference library
    for head in ("data:image/png;base64;", "data:image/png;base64,", "data:image/png;"):
        assert (decode_image(head + data) == FRAME).all()


@pytest.mark.parametrize("name", ["plain.png", "with blank.png", "ünïcode.png"])
def test_paths_with_and_without_quotes(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(bytes(cv2.imencode(".png", FRAME)[1]))
    for text in (str(path), f"file://{path}", path.as_uri()):
        assert (decode_image(text) == FRAME).all()


@pytest.mark.parametrize(
    "text",
    [
        "file:///absent.png",
        "data:image/png;base64;AAAA",
        "data:image/png;base64;*",
        "data:",
        "ftp://x/a.png",
        "",
        "image:1;1;rgb;A",
    ],
)
def test_images_that_cannot_be_read(text: str) -> None:
    with pytest.raises(ProtocolError):
        decode_image(text)

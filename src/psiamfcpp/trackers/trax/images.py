"""Images of the TraX protocol: in memory, as encoded data, as a file, or by URL."""

from __future__ import annotations

import base64
import binascii
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.images import read_image
from psiamfcpp.trackers.adapters.trax_worker import ProtocolError, read_memory_image

_URL_SECONDS, _URL_BYTES = 10.0, 1 << 27
# Files are written for the worker's eyes alone: fast rather than small.
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1)


def decode_image(text: str) -> Image:
    """Return the image ``(H, W, 3)`` uint8, BGR, of a TraX image in any of its forms.

    Raises:
        ProtocolError: the image cannot be read.
    """
    scheme = text.partition(":")[0]
    decode = _DECODERS.get(scheme, _from_url if "://" in text else _from_path)
    try:
        return decode(text)
    except (UserError, OSError, ValueError, urllib.error.URLError) as error:
        raise ProtocolError(f"image {text!r:.80} cannot be read: {error}") from None


def _from_memory(text: str) -> Image:
    return np.ascontiguousarray(read_memory_image(text)[:, :, ::-1])


def _from_data(text: str) -> Image:
    # The specification has data:image/jpeg;base64;..., RFC 2397 a comma, and the reference library no base64 at all.
    encoded = text[text.rfind(";") + 1 :].removeprefix("base64,")
    try:
        return _decoded(base64.b64decode(encoded, validate=True))
    except binascii.Error as error:
        raise ValueError(f"its base64 is damaged ({error})") from None


def _from_path(text: str) -> Image:
    path = text.removeprefix("file://")
    plain = Path(path)
    # The reference library does not quote paths; other clients may.
    return read_image(plain if plain.exists() else Path(urllib.parse.unquote(path)))


def _from_url(text: str) -> Image:
    if not text.startswith(("http://", "https://")):
        raise ValueError("only file, http and https are read")
    with urllib.request.urlopen(text, timeout=_URL_SECONDS) as answer:
        return _decoded(answer.read(_URL_BYTES))


def _decoded(data: bytes) -> Image:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        raise ValueError("it is no image that OpenCV knows")
    return np.asarray(image, np.uint8)


_DECODERS: dict[str, Callable[[str], Image]] = {"image": _from_memory, "data": _from_data, "file": _from_path}


class ImageSender:
    """Makes the text of a frame in the kind of image that a worker takes; without loss in all of them.

    Args:
        accepted: kinds that the worker takes; an empty list is a file path, the default of the protocol.
        folder: where files are written for a worker that takes paths alone; the two latest are kept.
    """

    def __init__(self, accepted: list[str], folder: Path):
        kind = next((kind for kind in _SENDERS if kind in (accepted or ["path"])), None)
        if kind is None:
            raise ProtocolError(f"it takes images by {', '.join(accepted)}: known are {', '.join(_SENDERS)}")
        self._send = _SENDERS[kind]
        self._folder = folder
        self._number = 0

    def text(self, frame: Image) -> str:
        """Return the text of a frame ``(H, W, 3)`` uint8, BGR.

        Raises:
            UserError: the frame is no such image.
        """
        if getattr(frame, "dtype", None) != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or not frame.size:
            raise UserError("frame is no image (height, width, 3) of uint8: convert it")
        return self._send(self, frame)

    def _memory(self, frame: Image) -> str:
        height, width = frame.shape[:2]
        pixels = base64.b64encode(frame[:, :, ::-1].tobytes()).decode()
        return f"image:{width};{height};rgb;{pixels}"

    def _data(self, frame: Image) -> str:
        return f"data:image/png;base64;{base64.b64encode(_png(frame)).decode()}"

    def _path(self, frame: Image) -> str:
        self._number += 1
        path = self._folder / f"{self._number:06}.png"
        path.write_bytes(_png(frame))
        (self._folder / f"{self._number - 2:06}.png").unlink(missing_ok=True)
        return f"file://{path}"


def _png(frame: Image) -> bytes:
    return bytes(cv2.imencode(".png", frame, _PNG)[1])


# By speed: memory needs no encoding. The reference library knows encoded data as buffer.
_SENDERS: dict[str, Callable[[ImageSender, Image], str]] = {
    "memory": ImageSender._memory,
    "data": ImageSender._data,
    "buffer": ImageSender._data,
    "path": ImageSender._path,
    "url": ImageSender._path,
}

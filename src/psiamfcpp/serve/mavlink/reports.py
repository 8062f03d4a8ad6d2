"""The messages of the camera: what it says of itself, of the video and of the chosen target."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common as mav

from psiamfcpp.serve.control import Control
from psiamfcpp.serve.follower import Shot, bearing
from psiamfcpp.trackers import Track
from psiamfcpp.version import __version__

_NAN = math.nan
# of CAMERA_TRACKING_TARGET_DATA; pymavlink lacks its name
_NO_TARGET_DATA = 0
_LARGEST_SIDE = 2**16 - 1


class Reports:
    """Makes messages by their number.

    Args:
        control: what is reported on.
        fov: horizontal field of view, degrees, if known; then bearings are reported.
        stream: address of the video; empty where ground stations can play none, and are offered none.
    """

    def __init__(self, control: Control, fov: float | None, stream: str):
        self._control, self._follower, self._fov, self._stream = control, control.follower, fov, stream
        self._boot = time.monotonic()
        self.makers: dict[int, Callable[[], list[Any]]] = {
            mav.MAVLINK_MSG_ID_HEARTBEAT: self._heartbeat,
            mav.MAVLINK_MSG_ID_CAMERA_INFORMATION: self._information,
            mav.MAVLINK_MSG_ID_CAMERA_SETTINGS: self._settings,
            mav.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS: self._capture_status,
            mav.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS: self._image_status,
        }
        if stream:
            self.makers[mav.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION] = self._stream_information
            self.makers[mav.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS] = self._stream_status
        if fov is not None:
            self.makers[mav.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT] = self._bearings

    def _heartbeat(self) -> list[Any]:
        kind, autopilot = mav.MAV_TYPE_CAMERA, mav.MAV_AUTOPILOT_INVALID
        return [mav.MAVLink_heartbeat_message(kind, autopilot, 0, 0, mav.MAV_STATE_ACTIVE, 3)]

    def _information(self) -> list[Any]:
        width, height = self._size_or_zero()
        flags = mav.CAMERA_CAP_FLAGS_HAS_TRACKING_POINT | mav.CAMERA_CAP_FLAGS_HAS_TRACKING_RECTANGLE
        if self._stream:
            flags |= mav.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
        return [
            mav.MAVLink_camera_information_message(
                self._time(),
                _text("psiamfcpp", 32),
                _text("tracker", 32),
                _version_number(__version__),
                _NAN,
                _NAN,
                _NAN,
                width,
                height,
                0,
                flags,
                0,
                b"",
            )
        ]

    def _settings(self) -> list[Any]:
        return [mav.MAVLink_camera_settings_message(self._time(), mav.CAMERA_MODE_VIDEO, _NAN, _NAN)]

    def _capture_status(self) -> list[Any]:
        recorder = self._control.recorder
        recording = int(recorder is not None and recorder.on)
        return [mav.MAVLink_camera_capture_status_message(self._time(), 0, recording, 0.0, 0, 0.0)]

    def _stream_information(self) -> list[Any]:
        width, height = self._size_or_zero()
        return [
            mav.MAVLink_video_stream_information_message(
                1,
                1,
                mav.VIDEO_STREAM_TYPE_RTSP,
                self._running(),
                self._follower.source_fps,
                width,
                height,
                0,
                0,
                round(self._fov or 0),
                b"camera",
                self._stream.encode()[:160],
            )
        ]

    def _stream_status(self) -> list[Any]:
        width, height = self._size_or_zero()
        rate = self._follower.source_fps
        fov = round(self._fov or 0)
        return [mav.MAVLink_video_stream_status_message(1, self._running(), rate, width, height, 0, 0, fov)]

    def _image_status(self) -> list[Any]:
        shot, track = self._target()
        status, mode, data = (
            mav.CAMERA_TRACKING_STATUS_FLAGS_IDLE,
            mav.CAMERA_TRACKING_MODE_NONE,
            _NO_TARGET_DATA,
        )
        corners = [_NAN] * 4
        if shot is not None and track is not None:
            mode, data = mav.CAMERA_TRACKING_MODE_RECTANGLE, mav.CAMERA_TRACKING_TARGET_DATA_IN_STATUS
            if track.state == "lost":
                # where it was is not where it is: a place would be taken for one
                status = mav.CAMERA_TRACKING_STATUS_FLAGS_ERROR
            else:
                status = mav.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE
                height, width = shot.image.shape[:2]
                x, y, w, h = track.box
                corners = [min(max(v, 0.0), 1.0) for v in (x / width, y / height, (x + w) / width, (y + h) / height)]
        return [mav.MAVLink_camera_tracking_image_status_message(status, mode, data, _NAN, _NAN, _NAN, *corners)]

    def _bearings(self) -> list[Any]:
        shot, track = self._target()
        if shot is None or track is None or track.state == "lost" or self._fov is None:
            return []
        names = (b"trk_az_deg", b"trk_el_deg")
        values = bearing(track, shot.image, self._fov)
        return [
            mav.MAVLink_named_value_float_message(self._time(), name, value)
            for name, value in zip(names, values, strict=True)
        ]

    def _target(self) -> tuple[Shot | None, Track | None]:
        shot = self._follower.newest
        track = None if shot is None or shot.selected is None else shot.tracks.get(shot.selected)
        return shot, track

    def _size_or_zero(self) -> tuple[int, int]:
        shot = self._follower.newest
        if shot is None:
            return 0, 0
        height, width = (min(side, _LARGEST_SIDE) for side in shot.image.shape[:2])
        return width, height

    def _running(self) -> int:
        return mav.VIDEO_STREAM_STATUS_FLAGS_RUNNING if self._follower.newest is not None else 0

    def _time(self) -> int:
        return int(1000 * (time.monotonic() - self._boot)) % 2**32


def _version_number(text: str) -> int:
    """Return a version as MAVLink has it: major | minor << 8 | patch << 16, without a suffix such as rc1."""
    # an epoch ("1!2.0") is no part of what users call the version
    release = re.match(r"v?(?:\d+!)?(\d+(?:\.\d+)*)", text.strip())
    parts = release[1].split(".")[:3] if release else []
    return sum(min(int(part[:4]), 255) << 8 * place for place, part in enumerate(parts))


def _text(text: str, size: int) -> list[int]:
    return list(text.encode()[:size].ljust(size, b"\0"))

"""The camera: what it says of itself, what it is told, and what it tells of the target.

It speaks MAVLink's camera protocol (https://mavlink.io/en/services/camera.html) and only ever tells where the target
is. It sends nothing that an autopilot takes as a wish to move; so bearings go out as NAMED_VALUE_FLOAT, not as
LANDING_TARGET, which a landing autopilot would steer by, and not as CAMERA_TRACKING_GEO_STATUS, whose position and
heading need the vehicle's own, which a camera does not know.
"""

from __future__ import annotations

import contextlib
import math
import re
import threading
import time
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common as mav

from psiamfcpp import __version__
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box
from psiamfcpp.serve.control import Control, NotOperatorError, TooManyError
from psiamfcpp.serve.follower import BusyError, Shot, bearing
from psiamfcpp.serve.mavlink.link import Link, Peer
from psiamfcpp.tracking import Track

_COMPONENT = mav.MAV_COMP_ID_CAMERA
_HEARTBEAT_US = 1_000_000
# Faster than any camera here, and a quarter of what 57600 baud can carry.
_SHORTEST_INTERVAL_US = 20_000
_DEFAULT_INTERVAL_US = {mav.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT: 200_000}
_LONGEST_WAIT_S = 0.1
# Legacy commands that ask for one message each; ground stations fall back to them.
_ASKING = {
    mav.MAV_CMD_REQUEST_CAMERA_INFORMATION: mav.MAVLINK_MSG_ID_CAMERA_INFORMATION,
    mav.MAV_CMD_REQUEST_CAMERA_SETTINGS: mav.MAVLINK_MSG_ID_CAMERA_SETTINGS,
    mav.MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS: mav.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS,
    mav.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION: mav.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION,
    mav.MAV_CMD_REQUEST_VIDEO_STREAM_STATUS: mav.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS,
}
_NAN = math.nan
# of CAMERA_TRACKING_TARGET_DATA; pymavlink lacks its name
_NO_TARGET_DATA = 0
_PAUSE_AFTER_FAULT_S = 1.0


class Camera:
    """A MAVLink camera component, served by a thread of its own while its ``with`` block lasts.

    Args:
        control: what it commands and tells of.
        link: how it is reached; closed by whoever opened it.
        system: MAVLink system of the vehicle.
        fov: horizontal field of view, degrees, if known; then bearings are told.
        stream: address of the video for ground stations; empty where there is none that they can play.
    """

    def __init__(self, control: Control, link: Link, system: int = 1, fov: float | None = None, stream: str = ""):
        if not 1 <= system <= 255:
            raise UserError(f"mavlink system is {system}: give 1 to 255")
        self._control, self._link, self._fov, self._stream = control, link, fov, stream
        self._mav = mav.MAVLink(None, system, _COMPONENT)
        self._parsers: dict[Peer, mav.MAVLink] = {}
        self._boot = time.monotonic()
        # the target that was taken up by MAVLink last, to be let go with the next
        self._own: int | None = None
        self._intervals_us: dict[int, int] = {mav.MAVLINK_MSG_ID_HEARTBEAT: _HEARTBEAT_US}
        if fov is not None:
            self._intervals_us |= _DEFAULT_INTERVAL_US
        self._due: dict[int, float] = {}
        self._makers: dict[int, Callable[[], list[Any]]] = {
            mav.MAVLINK_MSG_ID_HEARTBEAT: self._heartbeat,
            mav.MAVLINK_MSG_ID_CAMERA_INFORMATION: self._information,
            mav.MAVLINK_MSG_ID_CAMERA_SETTINGS: self._settings,
            mav.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS: self._capture_status,
            mav.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION: self._stream_information,
            mav.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS: self._stream_status,
            mav.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS: self._image_status,
        }
        if fov is not None:
            self._makers[mav.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT] = self._bearings
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="mavlink", daemon=True)

    def __enter__(self) -> Camera:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                wait = self._tell()
                received = self._link.receive(min(wait, _LONGEST_WAIT_S))
                if received is not None:
                    self._hear(*received)
            except Exception as error:  # a fault of ours here must not end the tracking
                self._control.follower.tell(f"mavlink failed: {type(error).__name__}: {error}")
                self._stop.wait(_PAUSE_AFTER_FAULT_S)

    # what is heard

    def _hear(self, data: bytes, peer: Peer) -> None:
        if self._link.whole or peer not in self._parsers:
            # a packet is whole or worthless, so what is left of one must not spoil the next
            parser = mav.MAVLink(None)
            parser.robust_parsing = True
            if not self._link.whole:
                self._parsers[peer] = parser
        else:
            parser = self._parsers[peer]
        try:
            packets = parser.parse_buffer(data) or []
        except Exception:  # whatever a foreign packet does to the parser, the next one is read
            self._parsers.pop(peer, None)
            return
        for packet in packets:
            if packet.get_type() == "BAD_DATA" or packet.get_type().startswith("UNKNOWN"):
                continue
            if packet.get_srcSystem() == self._mav.srcSystem and packet.get_srcComponent() == _COMPONENT:
                # our own, come back by a router
                continue
            self._link.accept(peer)
            self._take(packet)

    def _take(self, packet: Any) -> None:
        client = _client(packet)
        kind = packet.get_type()
        if kind == "HEARTBEAT":
            self._control.lease.keep(client)
        if kind not in ("COMMAND_LONG", "COMMAND_INT"):
            return
        mine = packet.target_system == self._mav.srcSystem and packet.target_component == _COMPONENT
        if not mine and (packet.target_system not in (0, self._mav.srcSystem) or packet.target_component != 0):
            return
        result, answers = self._obey(packet, client)
        if not mine and result != mav.MAV_RESULT_ACCEPTED:
            # a command to everybody that is not for cameras: whom it is for will answer
            return
        ack = mav.MAVLink_command_ack_message(
            packet.command, result, 0, 0, packet.get_srcSystem(), packet.get_srcComponent()
        )
        for message in (ack, *answers):
            self._send(message)

    def _obey(self, packet: Any, client: str) -> tuple[int, list[Any]]:
        """The result of a command, and the messages that it asked for."""
        command = packet.command
        x, y = (packet.param5, packet.param6) if packet.get_type() == "COMMAND_LONG" else (packet.x, packet.y)
        params = [packet.param1, packet.param2, packet.param3, packet.param4, x, y]
        if command == mav.MAV_CMD_REQUEST_MESSAGE:
            return self._request(params[0])
        if command in _ASKING:
            return self._request(_ASKING[command])
        if command == mav.MAV_CMD_SET_MESSAGE_INTERVAL:
            return self._set_interval(params[0], params[1]), []
        if command == mav.MAV_CMD_GET_MESSAGE_INTERVAL:
            number = _whole(params[0])
            if number not in self._makers:
                return mav.MAV_RESULT_UNSUPPORTED, []
            interval = self._intervals_us.get(number, -1)
            return mav.MAV_RESULT_ACCEPTED, [mav.MAVLink_message_interval_message(number, interval)]
        work = {
            mav.MAV_CMD_CAMERA_TRACK_POINT: self._track_point,
            mav.MAV_CMD_CAMERA_TRACK_RECTANGLE: self._track_rectangle,
            mav.MAV_CMD_CAMERA_STOP_TRACKING: self._stop_tracking,
        }.get(command)
        if work is None:
            return mav.MAV_RESULT_UNSUPPORTED, []
        return self._attempt(work, client, params), []

    def _attempt(self, work: Callable[[str, list[float]], None], client: str, params: list[float]) -> int:
        try:
            work(client, params)
        except (NotOperatorError, TooManyError, BusyError):
            return mav.MAV_RESULT_TEMPORARILY_REJECTED
        except UserError:
            return mav.MAV_RESULT_DENIED
        return mav.MAV_RESULT_ACCEPTED

    def _track_point(self, client: str, params: list[float]) -> None:
        (x, y), (width, height) = _shares(params[:2]), self._size()
        number, _ = self._control.start_at(client, x * (width - 1), y * (height - 1))
        self._replace(client, number)

    def _track_rectangle(self, client: str, params: list[float]) -> None:
        (left, top, right, bottom), (width, height) = _shares(params[:4]), self._size()
        if right <= left or bottom <= top:
            raise UserError("a rectangle needs its top left corner before its bottom right one")
        box: Box = (left * width, top * height, (right - left) * width, (bottom - top) * height)
        number, _ = self._control.start(client, box)
        self._replace(client, number)

    def _stop_tracking(self, client: str, _: list[float]) -> None:
        selected = self._selected()
        self._control.take(client)
        if selected is not None:
            with contextlib.suppress(UserError):  # it may have been stopped meanwhile
                self._control.follower.remove(selected)
        self._own = None
        # it wants nothing more, so another station may command
        self._control.lease.release(client)

    def _replace(self, client: str, number: int) -> None:
        """MAVLink knows one target: the one before goes, unless it was taken up in another way."""
        if self._own is not None:
            with contextlib.suppress(UserError):
                self._control.follower.remove(self._own)
        self._own = number

    def _request(self, wanted: float) -> tuple[int, list[Any]]:
        maker = self._makers.get(_whole(wanted))
        return (mav.MAV_RESULT_UNSUPPORTED, []) if maker is None else (mav.MAV_RESULT_ACCEPTED, maker())

    def _set_interval(self, wanted: float, interval: float) -> int:
        number = _whole(wanted)
        if number not in self._makers:
            return mav.MAV_RESULT_UNSUPPORTED
        if not (interval in (-1, 0) or _SHORTEST_INTERVAL_US <= interval <= 3.6e9):
            return mav.MAV_RESULT_DENIED
        self._due.pop(number, None)
        if interval > 0:
            self._intervals_us[number] = round(interval)
        elif number == mav.MAVLINK_MSG_ID_HEARTBEAT:
            # a component without heartbeat does not exist
            self._intervals_us[number] = _HEARTBEAT_US
        elif interval == 0 and self._fov is not None and number in _DEFAULT_INTERVAL_US:
            self._intervals_us[number] = _DEFAULT_INTERVAL_US[number]
        else:
            self._intervals_us.pop(number, None)
        return mav.MAV_RESULT_ACCEPTED

    # what is told

    def _tell(self) -> float:
        """Send what is due; seconds until the next is."""
        now = time.monotonic()
        for number, interval_us in list(self._intervals_us.items()):
            due = self._due.get(number, now)
            if due <= now:
                for message in self._makers[number]():
                    self._send(message)
                # from when it was due, so that the rate is held; but nothing is made up for
                due = max(due + interval_us / 1e6, now)
            self._due[number] = due
        return max(0.0, min(self._due[number] for number in self._intervals_us) - time.monotonic())

    def _send(self, message: Any) -> None:
        self._link.send(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256

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
                self._control.follower.source_fps,
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
        rate = self._control.follower.source_fps
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
        shot = self._control.follower.newest
        track = None if shot is None or shot.selected is None else shot.tracks.get(shot.selected)
        return shot, track

    def _selected(self) -> int | None:
        shot = self._control.follower.newest
        return None if shot is None else shot.selected

    def _size(self) -> tuple[int, int]:
        shot = self._control.follower.newest
        if shot is None:
            raise BusyError("no frame has come yet: try again")
        height, width = shot.image.shape[:2]
        return width, height

    def _size_or_zero(self) -> tuple[int, int]:
        return self._size() if self._control.follower.newest is not None else (0, 0)

    def _running(self) -> int:
        return mav.VIDEO_STREAM_STATUS_FLAGS_RUNNING if self._control.follower.newest is not None else 0

    def _time(self) -> int:
        return int(1000 * (time.monotonic() - self._boot)) % 2**32


def _client(packet: Any) -> str:
    return f"mavlink {packet.get_srcSystem()}/{packet.get_srcComponent()}"


def _shares(values: list[float]) -> list[float]:
    if not all(math.isfinite(v) and 0 <= v <= 1 for v in values):
        raise UserError("coordinates must lie between 0 and 1")
    return values


def _version_number(text: str) -> int:
    """Return a version as MAVLink has it: major | minor << 8 | patch << 16, without a suffix such as rc1."""
    # an epoch ("1!2.0") is no part of what users call the version
    release = re.match(r"v?(?:\d+!)?(\d+(?:\.\d+)*)", text.strip())
    parts = release[1].split(".")[:3] if release else []
    return sum(min(int(part[:4]), 255) << 8 * place for place, part in enumerate(parts))


def _whole(value: float) -> int:
    """A number that came as a float; -1 where it is none."""
    return int(value) if math.isfinite(value) and value == int(value) else -1


def _text(text: str, size: int) -> list[int]:
    return list(text.encode()[:size].ljust(size, b"\0"))

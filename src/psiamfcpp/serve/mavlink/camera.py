"""The camera: what it says of itself, which commands it takes, and what it reports of the target.

It speaks MAVLink's camera protocol (https://mavlink.io/en/services/camera.html) and only ever reports where the target
is. It sends nothing that an autopilot takes as a wish to move; so bearings go out as NAMED_VALUE_FLOAT, not as
LANDING_TARGET, which a landing autopilot would steer by, and not as CAMERA_TRACKING_GEO_STATUS, whose position and
heading need the vehicle's own, which a camera does not know.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common as mav

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box
from psiamfcpp.serve.control import Control, NotOperatorError, TooManyError
from psiamfcpp.serve.follower import BusyError
from psiamfcpp.serve.mavlink.commands import Commands
from psiamfcpp.serve.mavlink.link import Link, Peer
from psiamfcpp.serve.mavlink.reports import Reports

_COMPONENT = mav.MAV_COMP_ID_CAMERA
_HEARTBEAT_US = 1_000_000
# Ground stations take a component whose heartbeat is late for lost.
_HEARTBEAT_RANGE_US = (100_000, _HEARTBEAT_US)
# Faster than any camera here, and a quarter of what 57600 baud can carry; and what MESSAGE_INTERVAL can say.
_INTERVAL_RANGE_US = (20_000, 2**31 - 1)
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
_COMMANDS = ("COMMAND_LONG", "COMMAND_INT")
_GOOD = (mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_IN_PROGRESS)
_PAUSE_AFTER_FAULT_S = 0.05
_REPORTED_AGAIN_S = 10.0


class Camera:
    """A MAVLink camera component, served while its ``with`` block lasts.

    One thread hears and sends; it never waits for the tracker or for GrabCut, so heartbeats go on. Another carries
    out the commands that start and stop targets.

    Args:
        control: what it commands and reports.
        link: how it is reached; closed by whoever opened it.
        system: MAVLink system of the vehicle.
        fov: horizontal field of view, degrees, if known; then bearings are reported.
        stream: address of the video for ground stations; empty where there is none that they can play.
    """

    def __init__(self, control: Control, link: Link, system: int = 1, fov: float | None = None, stream: str = ""):
        if not 1 <= system <= 255:
            raise UserError(f"mavlink system is {system}: give 1 to 255")
        self._control, self._link, self._fov = control, link, fov
        self._mav = mav.MAVLink(None, system, _COMPONENT)
        self._parsers: dict[Peer, mav.MAVLink] = {}
        # the target that MAVLink started last, to be released with the next
        self._own: int | None = None
        self._intervals_us: dict[int, int] = {mav.MAVLINK_MSG_ID_HEARTBEAT: _HEARTBEAT_US}
        if fov is not None:
            self._intervals_us |= _DEFAULT_INTERVAL_US
        self._due: dict[int, float] = {}
        self._makers = Reports(control, fov, stream).makers
        self._sending = threading.Lock()
        self._reported: dict[str, float] = {}
        self._commands = Commands(self._report)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="mavlink", daemon=True)

    def __enter__(self) -> Camera:
        self._commands.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._commands.__exit__()

    def _run(self) -> None:
        while not self._stop.is_set():
            wait = self._tell()
            try:
                received = self._link.receive(min(wait, _LONGEST_WAIT_S))
            except Exception as error:  # a fault of ours here must not end the tracking
                self._report(error)
                self._stop.wait(_PAUSE_AFTER_FAULT_S)
                continue
            if received is not None:
                try:
                    self._hear(*received)
                except Exception as error:  # nor may a packet, or the next one not be heard
                    self._report(error)

    def _report(self, error: Exception) -> None:
        """Tell of a fault; of the same one not at every packet."""
        text, now = f"mavlink failed: {type(error).__name__}: {error}", time.monotonic()
        if now - self._reported.get(text, -math.inf) > _REPORTED_AGAIN_S:
            self._reported = {known: at for known, at in self._reported.items() if now - at <= _REPORTED_AGAIN_S}
            self._reported[text] = now
            self._control.follower.tell(text)

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
            self._link.accept(peer, packet.get_type() in _COMMANDS and self._for_us(packet))
            self._take(packet, peer)

    def _for_us(self, packet: Any) -> bool:
        mine = (0, self._mav.srcSystem)
        return packet.target_system in mine and packet.target_component in (mav.MAV_COMP_ID_ALL, _COMPONENT)

    def _take(self, packet: Any, peer: Peer) -> None:
        # the same system and component from elsewhere is another station: QGroundControls all have the same
        client = f"mavlink {packet.get_srcSystem()}/{packet.get_srcComponent()} at {peer}"
        kind = packet.get_type()
        if kind == "HEARTBEAT":
            self._control.lease.keep(client)
        if kind not in _COMMANDS or not self._for_us(packet):
            return
        work = {
            mav.MAV_CMD_CAMERA_TRACK_POINT: self._track_point,
            mav.MAV_CMD_CAMERA_TRACK_RECTANGLE: self._track_rectangle,
            mav.MAV_CMD_CAMERA_STOP_TRACKING: self._stop_tracking,
        }.get(packet.command)
        params = _params(packet)
        if work is None:
            self._answer(packet, *self._obey(packet, params))
            return
        # A stop after a new start is another one. Numbers as text, so that NaN is like NaN.
        stops = packet.command == mav.MAV_CMD_CAMERA_STOP_TRACKING
        key = (packet.command, *map(str, params), self._control.follower.started if stops else None)
        self._commands.give(
            client,
            key,
            getattr(packet, "confirmation", 0) > 0,
            lambda: self._attempt(work, client, params),
            lambda result: self._answer(packet, result, []),
        )

    def _answer(self, packet: Any, result: int, messages: list[Any]) -> None:
        if packet.target_component == mav.MAV_COMP_ID_ALL and result not in _GOOD:
            # a command to everybody that is not for cameras: whom it is for will answer
            return
        progress = 255 if result == mav.MAV_RESULT_IN_PROGRESS else 0  # 255 is unknown
        ack = mav.MAVLink_command_ack_message(
            packet.command, result, progress, 0, packet.get_srcSystem(), packet.get_srcComponent()
        )
        for message in (ack, *messages):
            self._send(message)

    def _obey(self, packet: Any, params: list[float]) -> tuple[int, list[Any]]:
        """The result of a command that only asks for messages, and those messages."""
        command = packet.command
        if command == mav.MAV_CMD_REQUEST_MESSAGE:
            return self._request(params[0])
        if command in _ASKING:
            return self._request(_ASKING[command])
        if command == mav.MAV_CMD_SET_MESSAGE_INTERVAL:
            by_name = packet.target_system != 0 and packet.target_component == _COMPONENT
            return self._set_interval(params[0], params[1], by_name), []
        if command == mav.MAV_CMD_GET_MESSAGE_INTERVAL:
            number = _whole(params[0])
            if number not in self._makers:
                return mav.MAV_RESULT_UNSUPPORTED, []
            interval = self._intervals_us.get(number, -1)
            return mav.MAV_RESULT_ACCEPTED, [mav.MAVLink_message_interval_message(number, interval)]
        return mav.MAV_RESULT_UNSUPPORTED, []

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
        """MAVLink knows one target: the one before is released, unless it was started in another way."""
        if self._own is not None:
            with contextlib.suppress(UserError):
                self._control.follower.remove(self._own)
        self._own = number

    def _request(self, wanted: float) -> tuple[int, list[Any]]:
        maker = self._makers.get(_whole(wanted))
        return (mav.MAV_RESULT_UNSUPPORTED, []) if maker is None else (mav.MAV_RESULT_ACCEPTED, maker())

    def _set_interval(self, wanted: float, interval: float, by_name: bool) -> int:
        number = _whole(wanted)
        if number not in self._makers:
            return mav.MAV_RESULT_UNSUPPORTED
        heartbeat = number == mav.MAVLINK_MSG_ID_HEARTBEAT
        shortest, longest = _HEARTBEAT_RANGE_US if heartbeat else _INTERVAL_RANGE_US
        if not (interval in (-1, 0) or shortest <= interval <= longest) or (heartbeat and not by_name):
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

    # what is reported

    def _tell(self) -> float:
        """Send what is due; seconds until the next is."""
        now = time.monotonic()
        for number, interval_us in list(self._intervals_us.items()):
            due = self._due.get(number, now)
            if due <= now:
                # from when it was due, so that the rate is held; but nothing is made up for
                self._due[number] = max(due + interval_us / 1e6, now)
                try:
                    for message in self._makers[number]():
                        self._send(message)
                except Exception as error:  # of one message; the others, above all the heartbeat, go on
                    self._report(error)
            else:
                self._due[number] = due
        return max(0.0, min(self._due[number] for number in self._intervals_us) - time.monotonic())

    def _send(self, message: Any) -> None:
        with self._sending:
            self._link.send(message.pack(self._mav))
            self._mav.seq = (self._mav.seq + 1) % 256

    def _selected(self) -> int | None:
        shot = self._control.follower.newest
        return None if shot is None else shot.selected

    def _size(self) -> tuple[int, int]:
        shot = self._control.follower.newest
        if shot is None:
            raise BusyError("no frame has come yet: try again")
        height, width = shot.image.shape[:2]
        return width, height


def _params(packet: Any) -> list[float]:
    """The first six parameters of a COMMAND_LONG or COMMAND_INT."""
    x, y = (packet.param5, packet.param6) if packet.get_type() == "COMMAND_LONG" else (packet.x, packet.y)
    return [packet.param1, packet.param2, packet.param3, packet.param4, x, y]


def _shares(values: list[float]) -> list[float]:
    if not all(math.isfinite(v) and 0 <= v <= 1 for v in values):
        raise UserError("coordinates must lie between 0 and 1")
    return values


def _whole(value: float) -> int:
    """A number that came as a float; -1 where it is none."""
    return int(value) if math.isfinite(value) and value == int(value) else -1

"""The MAVLink camera, spoken to by a ground station that knows nothing but pymavlink."""

from __future__ import annotations

import math
import os
import random
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mav

import psiamfcpp.serve.control
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import centre_error
from psiamfcpp.serve.control import Control
from psiamfcpp.serve.follower import Follower
from psiamfcpp.serve.mavlink import Camera, open_link
from psiamfcpp.serve.mavlink.link import UdpLink
from psiamfcpp.serve.mavlink.reports import Reports

from .conftest import BLOB, HEIGHT, TIMEOUT_S, WIDTH, Clock, Stream, ask, browse, free_port, later, live, served, until

SYSTEM, CAMERA = 1, mav.MAV_COMP_ID_CAMERA
# the blob as shares of the frame: left, top, right, bottom
RECTANGLE = (100 / WIDTH, 80 / HEIGHT, 140 / WIDTH, 110 / HEIGHT)


class Station:
    """A ground station on a UDP socket."""

    def __init__(self, port: int, listen: bool, system: int = 255):
        kind = "udpin" if listen else "udpout"
        self.link = mavutil.mavlink_connection(
            f"{kind}:127.0.0.1:{port}", source_system=system, source_component=190, dialect="common"
        )

    def heartbeat(self) -> None:
        self.link.mav.heartbeat_send(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, mav.MAV_STATE_ACTIVE)

    def wait(self, kind: str, seconds: float = TIMEOUT_S, **fields: Any) -> Any:
        """The next message of a kind with the given fields, sent by the camera."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            message = self.link.recv_match(type=kind, blocking=True, timeout=0.2)
            if message is not None and all(getattr(message, name) == value for name, value in fields.items()):
                assert (message.get_srcSystem(), message.get_srcComponent()) == (SYSTEM, CAMERA)
                return message
        raise AssertionError(f"no {kind} {fields} came")

    def command(
        self, command: int, *params: float, component: int = CAMERA, system: int = SYSTEM, confirmation: int = 0
    ) -> None:
        rest = [0.0] * (7 - len(params))
        self.link.mav.command_long_send(system, component, command, confirmation, *params, *rest)

    def ask(self, command: int, *params: float) -> int:
        """The result of a command."""
        self.drain()
        self.command(command, *params)
        # answers to other stations come by here too, now and then after the drain
        to_me = {"target_system": self.link.source_system, "target_component": 190}
        return int(self.wait("COMMAND_ACK", command=command, **to_me).result)

    def drain(self) -> None:
        while self.link.recv_match(blocking=False) is not None:
            pass

    def hears(self, kind: str, seconds: float = 0.5) -> bool:
        self.drain()
        return self.link.recv_match(type=kind, blocking=True, timeout=seconds) is not None

    def close(self) -> None:
        self.link.close()


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def camera(control: Control, port: int) -> Iterator[Camera]:
    """A camera that waits for ground stations."""
    link = open_link(f"udpin:127.0.0.1:{port}")
    with Camera(control, link, SYSTEM, fov=60.0) as running:
        yield running
    link.close()


@pytest.fixture
def join(camera: Camera, port: int) -> Iterator[Callable[..., Station]]:
    """A station that the camera has heard of."""
    stations: list[Station] = []

    def make(system: int = 255) -> Station:
        station = Station(port, listen=False, system=system)
        stations.append(station)
        station.heartbeat()
        # answered at once, where the next heartbeat may be a second away
        assert station.ask(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_STORAGE_INFORMATION) != 0
        return station

    yield make
    for station in stations:
        station.close()


@pytest.fixture
def station(join: Callable[..., Station]) -> Station:
    return join()


def unharmed(follower: Follower, number: int = 1) -> None:
    later(follower)
    assert follower.newest is not None
    assert follower.newest.tracks[number].state == "tracking"
    assert centre_error(follower.newest.tracks[number].box, BLOB) < 1


# what it says of itself


@pytest.mark.slow
def test_it_is_a_camera_whose_heart_beats(station: Station) -> None:
    first = station.wait("HEARTBEAT", type=mav.MAV_TYPE_CAMERA, autopilot=mav.MAV_AUTOPILOT_INVALID)
    second = station.wait("HEARTBEAT")
    # every message of ours has the next number, so that lost ones can be counted
    assert first.get_seq() != second.get_seq()


def test_it_can_track_points_and_rectangles(station: Station) -> None:
    assert station.ask(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_CAMERA_INFORMATION) == 0
    about = station.wait("CAMERA_INFORMATION")
    assert about.flags == mav.CAMERA_CAP_FLAGS_HAS_TRACKING_POINT | mav.CAMERA_CAP_FLAGS_HAS_TRACKING_RECTANGLE
    assert (about.resolution_h, about.resolution_v) == (WIDTH, HEIGHT)
    assert bytes(about.vendor_name).rstrip(b"\0") == b"psiamfcpp"


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (mav.MAVLINK_MSG_ID_CAMERA_SETTINGS, "CAMERA_SETTINGS"),
        (mav.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS, "CAMERA_CAPTURE_STATUS"),
        (mav.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS, "CAMERA_TRACKING_IMAGE_STATUS"),
    ],
)
def test_messages_come_when_asked_for(station: Station, number: int, kind: str) -> None:
    assert station.ask(mav.MAV_CMD_REQUEST_MESSAGE, number) == mav.MAV_RESULT_ACCEPTED
    station.wait(kind)


@pytest.mark.parametrize(
    ("version", "number"),
    [
        ("0.1.0", 0x000100),
        ("0.2.0rc1", 0x000200),
        ("1.2.3.post4", 0x030201),
        ("1.2", 0x000201),
        ("2!3", 3),
        ("1.0.dev7+local.5", 1),
        ("2026.11.4", 0x040BFF),
        ("unknown", 0),
        ("9" * 5000 + ".1", 0x0001FF),
    ],
)
def test_every_version_has_a_number(
    control: Control, monkeypatch: pytest.MonkeyPatch, version: str, number: int
) -> None:
    monkeypatch.setattr("psiamfcpp.serve.mavlink.reports.__version__", version)
    (message,) = Reports(control, None, "").makers[mav.MAVLINK_MSG_ID_CAMERA_INFORMATION]()
    assert message.firmware_version == number


def test_older_ways_of_asking_are_understood(station: Station) -> None:
    assert station.ask(mav.MAV_CMD_REQUEST_CAMERA_INFORMATION, 1) == mav.MAV_RESULT_ACCEPTED
    station.wait("CAMERA_INFORMATION")


@pytest.mark.slow
def test_an_rtsp_source_is_offered_to_ground_stations(control: Control, port: int) -> None:
    link = open_link(f"udpin:127.0.0.1:{port}")
    with Camera(control, link, SYSTEM, fov=60, stream="rtsp://10.0.0.2/main"):
        station = Station(port, listen=False)
        station.heartbeat()
        station.wait("HEARTBEAT")
        station.ask(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_CAMERA_INFORMATION)
        assert station.wait("CAMERA_INFORMATION").flags & mav.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
        station.ask(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION)
        about = station.wait("VIDEO_STREAM_INFORMATION")
        assert about.uri == "rtsp://10.0.0.2/main"
        station.ask(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS)
        for message in (about, station.wait("VIDEO_STREAM_STATUS")):
            assert (message.resolution_h, message.resolution_v, message.hfov) == (WIDTH, HEIGHT, 60)
            assert message.flags == mav.VIDEO_STREAM_STATUS_FLAGS_RUNNING
        station.close()
    link.close()


# what it is told


@pytest.mark.slow
def test_a_rectangle_is_followed_and_its_status_streamed(station: Station, stream: Stream, follower: Follower) -> None:
    interval = 50_000
    number = mav.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS
    assert station.ask(mav.MAV_CMD_SET_MESSAGE_INTERVAL, number, interval) == mav.MAV_RESULT_ACCEPTED
    idle = station.wait("CAMERA_TRACKING_IMAGE_STATUS")
    assert (idle.tracking_status, idle.tracking_mode) == (0, 0)
    assert station.ask(mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, *RECTANGLE) == mav.MAV_RESULT_ACCEPTED
    status = station.wait("CAMERA_TRACKING_IMAGE_STATUS", tracking_status=mav.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE)
    assert status.tracking_mode == mav.CAMERA_TRACKING_MODE_RECTANGLE
    assert status.target_data == mav.CAMERA_TRACKING_TARGET_DATA_IN_STATUS
    corners = (status.rec_top_x, status.rec_top_y, status.rec_bottom_x, status.rec_bottom_y)
    assert corners == pytest.approx(RECTANGLE, abs=0.005)
    stream.blobs = [(110, 85, 40, 30)]
    until(lambda: abs(station.wait("CAMERA_TRACKING_IMAGE_STATUS").rec_top_x - 110 / WIDTH) < 0.005)
    # where it is lost, that is said, and no place
    stream.blobs = [(620, 470, 1, 1)]
    lost = station.wait("CAMERA_TRACKING_IMAGE_STATUS", tracking_status=mav.CAMERA_TRACKING_STATUS_FLAGS_ERROR)
    assert math.isnan(lost.rec_top_x)
    assert station.ask(mav.MAV_CMD_CAMERA_STOP_TRACKING) == mav.MAV_RESULT_ACCEPTED
    station.wait("CAMERA_TRACKING_IMAGE_STATUS", tracking_status=mav.CAMERA_TRACKING_STATUS_FLAGS_IDLE)
    until(lambda: follower.newest and not follower.newest.tracks)


@pytest.mark.slow
def test_the_stream_comes_at_the_rate_that_was_asked_for(station: Station) -> None:
    number = mav.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS
    start = time.monotonic()
    station.ask(mav.MAV_CMD_SET_MESSAGE_INTERVAL, number, 100_000)
    for _ in range(11):
        station.wait("CAMERA_TRACKING_IMAGE_STATUS")
    # never more often (one per frame would take 0.2 s); how much less is a matter of the machine
    assert time.monotonic() - start >= 0.99
    assert station.ask(mav.MAV_CMD_GET_MESSAGE_INTERVAL, number) == mav.MAV_RESULT_ACCEPTED
    assert station.wait("MESSAGE_INTERVAL", message_id=number).interval_us == 100_000
    assert station.ask(mav.MAV_CMD_SET_MESSAGE_INTERVAL, number, -1) == mav.MAV_RESULT_ACCEPTED
    assert not station.hears("CAMERA_TRACKING_IMAGE_STATUS")


def test_a_point_is_followed(station: Station, follower: Follower) -> None:
    result = station.ask(mav.MAV_CMD_CAMERA_TRACK_POINT, 119 / WIDTH, 94 / HEIGHT, 0.05)
    assert result == mav.MAV_RESULT_ACCEPTED
    track = until(lambda: follower.newest and follower.newest.tracks.get(1))
    assert track.box == pytest.approx(BLOB, abs=3)


def test_commands_may_come_as_command_int(station: Station, follower: Follower) -> None:
    command = mav.MAV_CMD_CAMERA_TRACK_RECTANGLE
    station.link.mav.command_int_send(SYSTEM, CAMERA, 0, command, 0, 0, *RECTANGLE, 0, 0, 0)
    assert station.wait("COMMAND_ACK", command=command).result == mav.MAV_RESULT_ACCEPTED
    until(lambda: follower.newest and follower.newest.tracks)


def test_a_new_rectangle_replaces_the_one_before_and_no_other(station: Station, follower: Follower) -> None:
    follower.add(BLOB)
    for number in range(3):
        rectangle = (RECTANGLE[0] + number / WIDTH, *RECTANGLE[1:])
        assert station.ask(mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, *rectangle) == mav.MAV_RESULT_ACCEPTED
    until(lambda: follower.newest and list(follower.newest.tracks) == [1, 4])


def test_bearings_of_the_chosen_target_are_told(station: Station, follower: Follower) -> None:
    follower.add(BLOB)
    azimuth = station.wait("NAMED_VALUE_FLOAT", name="trk_az_deg")
    elevation = station.wait("NAMED_VALUE_FLOAT", name="trk_el_deg")
    # focal length 320 / tan 30 = 554.3; centre 119.5, 94.5 is 200 left of and 145 above the axis
    assert azimuth.value == pytest.approx(math.degrees(math.atan2(-200, 554.26)), abs=0.2)
    assert elevation.value == pytest.approx(math.degrees(math.atan2(145, math.hypot(200, 554.26))), abs=0.2)


@pytest.mark.parametrize(
    ("command", "params", "result"),
    [
        (mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, (math.nan, 0, 1, 1), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, (0.5, 0.5, 0.4, 0.6), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, (-0.1, 0, 0.2, 0.2), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, (0.1, 0.1, 1.2, 0.2), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, (0.1, 0.1, 0.1001, 0.1001), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, (math.inf,) * 4, mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_CAMERA_TRACK_POINT, (math.nan, 0.5), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_CAMERA_TRACK_POINT, (640.0, 0.5), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_SET_MESSAGE_INTERVAL, (275, 10), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_SET_MESSAGE_INTERVAL, (275, math.nan), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_SET_MESSAGE_INTERVAL, (275, 3.6e9), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_SET_MESSAGE_INTERVAL, (275, 2**31), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_SET_MESSAGE_INTERVAL, (0, 20_000), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_SET_MESSAGE_INTERVAL, (0, 60_000_000), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_REQUEST_MESSAGE, (269,), mav.MAV_RESULT_UNSUPPORTED),
        (mav.MAV_CMD_REQUEST_MESSAGE, (270,), mav.MAV_RESULT_UNSUPPORTED),
        (mav.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION, (0,), mav.MAV_RESULT_UNSUPPORTED),
        (mav.MAV_CMD_SET_MESSAGE_INTERVAL, (30, 100_000), mav.MAV_RESULT_UNSUPPORTED),
        (mav.MAV_CMD_REQUEST_MESSAGE, (276,), mav.MAV_RESULT_UNSUPPORTED),
        (mav.MAV_CMD_REQUEST_MESSAGE, (math.nan,), mav.MAV_RESULT_UNSUPPORTED),
        (mav.MAV_CMD_REQUEST_MESSAGE, (1e30,), mav.MAV_RESULT_UNSUPPORTED),
        (mav.MAV_CMD_NAV_TAKEOFF, (), mav.MAV_RESULT_UNSUPPORTED),
        (mav.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW, (), mav.MAV_RESULT_UNSUPPORTED),
    ],
)
def test_what_cannot_be_done_is_answered_and_harms_nothing(
    station: Station, follower: Follower, command: int, params: tuple[float, ...], result: int
) -> None:
    follower.add(BLOB)
    assert station.ask(command, *params) == result
    unharmed(follower)


def test_a_web_operator_is_not_overridden(station: Station, control: Control, follower: Follower) -> None:
    control.start("page", BLOB)
    for command, params in (
        (mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, (0.5, 0.5, 0.6, 0.6)),
        (mav.MAV_CMD_CAMERA_STOP_TRACKING, ()),
    ):
        assert station.ask(command, *params) == mav.MAV_RESULT_TEMPORARILY_REJECTED
    unharmed(follower)
    control.lease.release("page")
    assert station.ask(mav.MAV_CMD_CAMERA_STOP_TRACKING) == mav.MAV_RESULT_ACCEPTED


def test_two_stations_are_both_told_and_one_commands(join: Callable[..., Station], follower: Follower) -> None:
    first, second = join(255), join(254)
    assert first.ask(mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, *RECTANGLE) == mav.MAV_RESULT_ACCEPTED
    refused = second.ask(mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, 0.5, 0.5, 0.6, 0.6)
    assert refused == mav.MAV_RESULT_TEMPORARILY_REJECTED
    number = mav.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS
    assert second.ask(mav.MAV_CMD_SET_MESSAGE_INTERVAL, number, 50_000) == mav.MAV_RESULT_ACCEPTED
    for station in (first, second):
        status = station.wait("CAMERA_TRACKING_IMAGE_STATUS", tracking_status=1)
        assert status.rec_top_x == pytest.approx(RECTANGLE[0], abs=0.005)
    # who stops wants nothing more: now the other may
    assert first.ask(mav.MAV_CMD_CAMERA_STOP_TRACKING) == mav.MAV_RESULT_ACCEPTED
    assert second.ask(mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, *RECTANGLE) == mav.MAV_RESULT_ACCEPTED


@pytest.mark.slow
def test_commands_for_others_are_left_alone(station: Station) -> None:
    track, takeoff = mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, mav.MAV_CMD_NAV_TAKEOFF
    station.command(track, *RECTANGLE, component=mav.MAV_COMP_ID_CAMERA2)
    station.command(track, *RECTANGLE, system=7)
    # to everybody, but not a camera's matter: the autopilot's answer must stay the only one
    station.command(takeoff, component=mav.MAV_COMP_ID_ALL)
    station.command(mav.MAV_CMD_REQUEST_MESSAGE, 30, component=mav.MAV_COMP_ID_ALL)
    assert not station.hears("COMMAND_ACK", 1.0)
    station.command(mav.MAV_CMD_REQUEST_MESSAGE, 259, component=mav.MAV_COMP_ID_ALL)
    station.wait("CAMERA_INFORMATION")


# commands that are sent again


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """GrabCut that is not done before this is set."""
    done = threading.Event()
    propose = psiamfcpp.serve.control.propose_box

    def slow(*args: Any) -> Any:
        assert done.wait(TIMEOUT_S)
        return propose(*args)

    monkeypatch.setattr("psiamfcpp.serve.control.propose_box", slow)
    return done


TAP = (119 / WIDTH, 94 / HEIGHT)


@pytest.fixture
def long_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """A repeat is known as one however slow the machine is."""
    monkeypatch.setattr("psiamfcpp.serve.mavlink.commands._REPEATED_WITHIN_S", 600)


@pytest.mark.slow
def test_a_repeated_command_is_answered_and_not_repeated(
    station: Station, follower: Follower, held: threading.Event, long_memory: None
) -> None:
    command = mav.MAV_CMD_CAMERA_TRACK_POINT
    for confirmation in range(4):
        station.command(command, *TAP, confirmation=confirmation)
    for _ in range(3):
        assert station.wait("COMMAND_ACK", command=command).result == mav.MAV_RESULT_IN_PROGRESS
    # meanwhile it is alive, and hears others
    station.wait("HEARTBEAT")
    station.wait("HEARTBEAT")
    assert station.ask(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_CAMERA_SETTINGS) == 0
    held.set()
    assert station.wait("COMMAND_ACK", command=command).result == mav.MAV_RESULT_ACCEPTED
    # with the confirmation of a repeat, and as MAVSDK repeats, without
    for confirmation in (4, 0):
        station.command(command, *TAP, confirmation=confirmation)
        assert station.wait("COMMAND_ACK", command=command).result == mav.MAV_RESULT_ACCEPTED
    assert follower.started == 1
    # one that another came after is a repeat only if it says so
    assert station.ask(mav.MAV_CMD_CAMERA_STOP_TRACKING) == mav.MAV_RESULT_ACCEPTED
    station.command(command, *TAP, confirmation=1)
    assert station.wait("COMMAND_ACK", command=command).result == mav.MAV_RESULT_ACCEPTED
    assert follower.started == 1
    assert station.ask(command, *TAP) == mav.MAV_RESULT_ACCEPTED
    assert follower.started == 2


def test_a_repeated_stop_stops_one_target(station: Station, follower: Follower, long_memory: None) -> None:
    for _ in range(3):
        follower.add(BLOB)
    for confirmation in (0, 1, 0):
        station.command(mav.MAV_CMD_CAMERA_STOP_TRACKING, confirmation=confirmation)
        assert station.wait("COMMAND_ACK").result == mav.MAV_RESULT_ACCEPTED
    until(lambda: follower.newest and list(follower.newest.tracks) == [1, 2])
    # what was started since is another one to stop
    follower.add(BLOB)
    assert station.ask(mav.MAV_CMD_CAMERA_STOP_TRACKING) == mav.MAV_RESULT_ACCEPTED
    until(lambda: follower.newest and list(follower.newest.tracks) == [1, 2])


def test_the_same_command_of_another_station_or_later_is_another(
    join: Callable[..., Station], follower: Follower, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = join(255), join(254)
    assert first.ask(mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, *RECTANGLE) == mav.MAV_RESULT_ACCEPTED
    refused = second.ask(mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, *RECTANGLE)
    assert refused == mav.MAV_RESULT_TEMPORARILY_REJECTED
    monkeypatch.setattr("psiamfcpp.serve.mavlink.commands._REPEATED_WITHIN_S", 0)
    assert first.ask(mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, *RECTANGLE) == mav.MAV_RESULT_ACCEPTED
    assert follower.started == 2


@pytest.mark.slow
def test_a_fault_in_a_command_or_a_message_is_told_and_leaves_the_rest(
    station: Station, camera: Camera, control: Control, follower: Follower, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any) -> Any:
        raise RuntimeError("out of order")

    monkeypatch.setattr("psiamfcpp.serve.mavlink.camera._REPORTED_AGAIN_S", 3600)
    monkeypatch.setattr(control, "start_at", broken)
    camera._makers[mav.MAVLINK_MSG_ID_CAMERA_SETTINGS] = broken
    assert station.ask(mav.MAV_CMD_CAMERA_TRACK_POINT, *TAP) == mav.MAV_RESULT_FAILED
    camera._intervals_us[mav.MAVLINK_MSG_ID_CAMERA_SETTINGS] = 20_000
    for _ in range(2):
        station.wait("HEARTBEAT")
    assert station.ask(mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, *RECTANGLE) == mav.MAV_RESULT_ACCEPTED
    # hundreds of faults are one event
    told = [event.text for event in follower.events() if "out of order" in event.text]
    assert told == ["mavlink failed: RuntimeError: out of order"]


# whom it hears


def test_everybody_means_it_too_but_does_not_set_its_heartbeat(station: Station) -> None:
    for system in (0, SYSTEM):
        station.command(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_CAMERA_SETTINGS, system=system)
        station.wait("COMMAND_ACK", result=mav.MAV_RESULT_ACCEPTED)
        station.wait("CAMERA_SETTINGS")
    # named, though in every system: it says what it cannot do
    station.command(mav.MAV_CMD_NAV_TAKEOFF, system=0)
    station.wait("COMMAND_ACK", result=mav.MAV_RESULT_UNSUPPORTED)
    interval = mav.MAV_CMD_SET_MESSAGE_INTERVAL
    station.command(interval, 0, 100_000, system=0)
    station.wait("COMMAND_ACK", result=mav.MAV_RESULT_DENIED)
    station.command(interval, 0, 100_000, component=mav.MAV_COMP_ID_ALL)
    station.command(mav.MAV_CMD_GET_MESSAGE_INTERVAL, 0)
    assert station.wait("MESSAGE_INTERVAL").interval_us == 1_000_000
    assert station.ask(interval, 0, 200_000) == mav.MAV_RESULT_ACCEPTED
    assert station.ask(interval, 275, 2**31 - 128) == mav.MAV_RESULT_ACCEPTED
    assert station.ask(mav.MAV_CMD_GET_MESSAGE_INTERVAL, 275) == mav.MAV_RESULT_ACCEPTED
    assert station.wait("MESSAGE_INTERVAL", message_id=275).interval_us == 2**31 - 128


def test_stations_with_the_same_numbers_are_two(join: Callable[..., Station], control: Control) -> None:
    first, second = join(), join()
    assert first.ask(mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, *RECTANGLE) == mav.MAV_RESULT_ACCEPTED
    second.command(mav.MAV_CMD_CAMERA_STOP_TRACKING)
    second.wait("COMMAND_ACK", result=mav.MAV_RESULT_TEMPORARILY_REJECTED)
    # nor is a page that bears its name
    assert control.lease.holder is not None
    with served(control) as address, browse(address) as http:
        for name in (control.lease.holder, "mavlink 255/190", control.lease.holder.removeprefix("mavlink ")):
            assert http.delete("/api/targets", headers={"X-Client": name}).status_code == 409
        with live(address, control.lease.holder) as page:
            assert not ask(page, type="stop")["ok"]


@pytest.mark.slow
def test_a_flood_of_one_station_costs_no_other_a_command(
    control: Control, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # for the link no time passes, so that nobody's share grows
    link = UdpLink("127.0.0.1", port, listen=True, clock=lambda: 0.0)
    heard: Counter[int] = Counter()
    allowed = link._allowed

    def counted(peer: Any) -> bool:
        heard[peer[1]] += 1
        return allowed(peer)

    monkeypatch.setattr(link, "_allowed", counted)
    flood = bytes(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(mav.MAVLink(None, 200, 190)))
    with Camera(control, link, SYSTEM), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as foreign:
        station = Station(port, listen=False)
        assert station.ask(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_CAMERA_SETTINGS) == 0
        foreign.bind(("127.0.0.1", 0))
        for sent in range(50, 3001, 50):
            for _ in range(50):
                foreign.sendto(flood, ("127.0.0.1", port))
            until(lambda sent=sent: heard[foreign.getsockname()[1]] >= sent)
        for _ in range(8):
            for _ in range(20):
                foreign.sendto(flood, ("127.0.0.1", port))
            assert station.ask(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_CAMERA_SETTINGS) == 0
        station.close()
    link.close()


def test_a_link_has_a_share_for_each_peer_and_room_for_who_commands() -> None:
    link = UdpLink("127.0.0.1", 9, listen=False, clock=lambda: 0.0)
    try:
        known, other = ("10.0.0.1", 5), ("10.0.0.2", 5)
        link.accept(known, commands=True)
        assert sum(link._allowed(other) for _ in range(3000)) == 100
        # a crowd of ports is one address, and strangers are few in all
        assert sum(link._allowed(("10.0.0.2", port)) for port in range(6, 600)) == 0
        crowd = [(f"10.0.{n // 250}.{n % 250 + 3}", 5) for n in range(900)]
        assert sum(link._allowed(one) for one in crowd) == 200
        assert sum(link._allowed(known) for _ in range(3000)) == 500
        for one in crowd:
            link.accept(one)
        assert known in link._peers
        assert len(link._peers) == 16
        assert crowd[-1] in link._peers
    finally:
        link.close()


def test_whoever_speaks_from_ever_new_ports_pushes_out_itself() -> None:
    clock = Clock()
    link = UdpLink("127.0.0.1", 9, listen=False, clock=clock)
    try:
        stations = [("10.0.0.1", port) for port in range(5)]
        for station in stations:
            link.accept(station)
        for port in range(200):
            clock.now += 0.01
            # each of them commands, which counts for nothing against an address of few ports
            link.accept(("10.0.0.2", port), commands=True)
        assert set(stations) <= link._peers.keys()
        assert ("10.0.0.2", 199) in link._peers
        assert len(link._peers) == 16
        # even at one address those stay that were there before
        first = next(peer for peer in link._peers if peer[0] == "10.0.0.2")
        for port in range(200, 400):
            clock.now += 0.01
            link.accept(("10.0.0.2", port), commands=True)
        assert first in link._peers
        # and who falls silent makes room
        clock.now += 16
        link.accept(stations[0])
        link.send(b"")
        assert list(link._peers) == [stations[0]]
    finally:
        link.close()


# how it lasts


@pytest.mark.slow
def test_random_bytes_and_broken_packets_harm_nothing(station: Station, port: int, follower: Follower) -> None:
    follower.add(BLOB)
    rng = random.Random(0)
    whole = mav.MAVLink_command_long_message(1, 100, mav.MAV_CMD_CAMERA_STOP_TRACKING, 0, *[0.0] * 7)
    packet = bytes(whole.pack(mav.MAVLink(None, 255, 190)))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as foreign:
        for number in range(400):
            if number % 50 == 0:  # no more at once than the buffers of every system hold
                assert station.ask(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_CAMERA_SETTINGS) == 0
            data = bytearray(rng.choice((packet, bytes([0xFD]) + rng.randbytes(rng.randrange(300)), rng.randbytes(40))))
            if data == packet:
                # one wrong bit anywhere but in what is not checked
                data[rng.randrange(1, len(data))] ^= 1 << rng.randrange(8)
            foreign.sendto(bytes(data[: rng.choice((len(data), len(data), 5))]), ("127.0.0.1", port))
        foreign.sendto(b"", ("127.0.0.1", port))
        # who speaks no MAVLink is not spoken to
        foreign.settimeout(1.5)
        with pytest.raises(OSError, match="timed out"):
            foreign.recv(2048)
    unharmed(follower)
    assert station.ask(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_CAMERA_SETTINGS) == 0


def test_messages_of_other_dialects_and_kinds_are_ignored(station: Station, follower: Follower) -> None:
    follower.add(BLOB)
    station.link.mav.attitude_send(0, 0, 0, 0, 0, 0, 0)
    station.link.mav.param_set_send(SYSTEM, CAMERA, b"X", 1.0, 9)
    station.link.mav.statustext_send(0, b"hello")
    assert station.ask(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_CAMERA_SETTINGS) == 0
    unharmed(follower)


def test_a_flood_of_commands_starts_nothing_and_harms_nothing(station: Station, follower: Follower) -> None:
    follower.add(BLOB)
    results: set[int] = set()
    # no more at once than the buffers of every system hold
    for _ in range(6):
        for _ in range(50):
            station.command(mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, 0.5, 0.5, 0.5001, 0.5001)
        # how many are rejected unread depends on how fast the others are answered: see mavlink/test_commands.py
        results |= {station.wait("COMMAND_ACK").result for _ in range(50)}
    assert results <= {mav.MAV_RESULT_TEMPORARILY_REJECTED, mav.MAV_RESULT_IN_PROGRESS, mav.MAV_RESULT_DENIED}
    unharmed(follower)


@pytest.mark.slow
def test_a_link_that_is_lost_comes_back(control: Control, port: int, follower: Follower) -> None:
    link = open_link(f"udpout:127.0.0.1:{port}")
    with Camera(control, link, SYSTEM):
        # nobody is there at first
        time.sleep(0.3)
        for _ in range(2):
            station = Station(port, listen=True)
            station.wait("HEARTBEAT")
            assert station.ask(mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, *RECTANGLE) == mav.MAV_RESULT_ACCEPTED
            station.close()
            time.sleep(1.2)
        assert follower.newest is not None
        assert len(follower.newest.tracks) == 1
    link.close()


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals")
def test_a_serial_line_is_a_link_too(control: Control, follower: Follower) -> None:
    main, device = os.openpty()
    link = open_link(f"serial:{os.ttyname(device)}:57600")
    coder = mav.MAVLink(None, 255, 190)
    reader = mav.MAVLink(None)
    reader.robust_parsing = True
    with Camera(control, link, SYSTEM):
        command = mav.MAVLink_command_long_message(
            1, 100, mav.MAV_CMD_CAMERA_TRACK_RECTANGLE, 0, *RECTANGLE, 0.0, 0.0, 0.0
        )
        # in the midst of noise, and in parts
        data = b"noise" + bytes(command.pack(coder))
        for start in range(0, len(data), 7):
            os.write(main, data[start : start + 7])
        seen: dict[str, Any] = {}
        end = time.monotonic() + TIMEOUT_S
        while not {"HEARTBEAT", "COMMAND_ACK"} <= seen.keys() and time.monotonic() < end:
            seen |= {message.get_type(): message for message in reader.parse_buffer(os.read(main, 512)) or []}
        assert seen["COMMAND_ACK"].result == mav.MAV_RESULT_ACCEPTED
    link.close()
    os.close(main)
    os.close(device)
    until(lambda: follower.newest and follower.newest.tracks)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is no link"),
        ("udp:127.0.0.1:1", "is no link"),
        ("udpin:127.0.0.1", "is no link"),
        ("udpin:127.0.0.1:0", "is no link"),
        ("udpin:127.0.0.1:99999", "is no link"),
        ("udpin:no.such.host.invalid:14550", "cannot be opened"),
        ("udpin:203.0.113.7:14550", "cannot be opened"),
        ("serial:/dev/nothing", "cannot be opened"),
        ("serial:/dev/null:fast", "'fast' is no baud rate"),
    ],
)
def test_links_that_are_none_say_so(text: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        open_link(text)


def test_it_never_sends_what_moves_anything() -> None:
    folder = Path(__file__).parents[2] / "src/psiamfcpp/serve/mavlink"
    text = "".join(path.read_text() for path in folder.glob("*.py"))
    sent = {part.split("_message(")[0] for part in text.split("mav.MAVLink_")[1:]}
    assert sent == {
        "camera_capture_status",
        "camera_information",
        "camera_settings",
        "camera_tracking_image_status",
        "command_ack",
        "heartbeat",
        "message_interval",
        "named_value_float",
        "video_stream_information",
        "video_stream_status",
    }

"""The API over real sockets: what it does."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from psiamfcpp.geometry import centre_error
from psiamfcpp.serve.control import Control
from psiamfcpp.serve.follower import Follower
from psiamfcpp.trackers import TargetPool

from .conftest import BLOB, HEIGHT, TIMEOUT_S, WIDTH, Stream, ask, browse, later, live, served, state, until


@pytest.mark.slow
def test_a_target_is_started_followed_and_stopped_by_rest(http: httpx.Client, stream: Stream) -> None:
    answer = http.post("/api/targets", json={"box": BLOB})
    assert (answer.status_code, answer.json()) == (201, {"id": 1, "box": list(BLOB)})
    stream.blobs = [(112, 85, 40, 30)]

    def followed() -> Any:
        told = http.get("/api/state").json()
        return told if centre_error(told["targets"][0]["box"], stream.blobs[0]) < 1 else None

    told = until(followed)
    assert (told["width"], told["height"], told["selected"]) == (WIDTH, HEIGHT, 1)
    assert told["targets"][0]["state"] == "tracking"
    assert "bearing" not in told["targets"][0]
    assert http.delete("/api/targets/1").json() == {"ok": True}
    until(lambda: not http.get("/api/state").json()["targets"])
    texts = [event["text"] for event in http.get("/api/events").json()]
    assert texts == ["target 1 is followed", "target 1 was stopped"]
    assert [event["number"] for event in http.get("/api/events", params={"after": 1}).json()] == [2]


@pytest.mark.slow
def test_a_model_that_states_nothing_is_served(stream: Stream, blob_engine: Any) -> None:
    blob_engine.spec = dataclasses.replace(blob_engine.spec, calibration=None)
    with Follower(stream.open, TargetPool()) as follower:
        until(lambda: follower.newest)
        with served(Control(follower)) as where, httpx.Client(base_url=f"http://{where}", timeout=30) as http:
            assert http.post("/api/targets", json={"box": BLOB}).status_code == 201
            (target,) = until(lambda: http.get("/api/state").json()["targets"])
            assert target["state"] is None and 0 < target["score"] <= 1
            with live(where) as socket:
                (target,) = until(lambda: state(socket)["targets"])
                assert target["state"] is None


def test_a_point_becomes_a_box(http: httpx.Client) -> None:
    proposed = http.post("/api/propose", json={"point": [118, 94]}).json()["box"]
    assert proposed == pytest.approx(BLOB, abs=3)
    assert http.post("/api/targets", json={"point": [118, 94]}).json()["box"] == pytest.approx(BLOB, abs=3)


@pytest.mark.slow
def test_several_targets_and_the_chosen_one(http: httpx.Client, stream: Stream, follower: Follower) -> None:
    stream.blobs = [BLOB, (520, 380, 30, 40)]
    later(follower)
    for box in stream.blobs:
        assert http.post("/api/targets", json={"box": box}).status_code == 201
    assert http.put("/api/selected", json={"id": 1}).json() == {"ok": True}
    told = until(lambda: (s := http.get("/api/state").json())["selected"] == 1 and s)
    assert [target["id"] for target in told["targets"]] == [1, 2]
    assert http.delete("/api/targets").json() == {"ok": True}
    until(lambda: not http.get("/api/state").json()["targets"])


@pytest.mark.slow
def test_the_socket_tells_of_frames_and_obeys(address: str, stream: Stream) -> None:
    with live(address) as socket:
        first = state(socket)
        assert first["operator"] == "none"
        reply = ask(socket, type="start", box=BLOB)
        assert reply == {"type": "reply", "request": 7, "ok": True, "id": 1, "box": list(BLOB)}
        told = until(lambda: (s := state(socket))["targets"] and s)
        assert told["operator"] == "you"
        numbers = [state(socket)["frame"] for _ in range(5)]
        assert numbers == sorted(set(numbers))
        assert ask(socket, type="propose", point=[118, 94])["box"] == pytest.approx(BLOB, abs=3)
        assert ask(socket, type="select", id=1)["ok"]
        assert ask(socket, type="stop")["ok"]
        until(lambda: not state(socket)["targets"])
        assert ask(socket, type="operator", take=False)["ok"]
        until(lambda: state(socket)["operator"] == "none")


def test_latency_is_measured_and_told(address: str) -> None:
    with live(address) as socket:
        assert ask(socket, type="start", box=BLOB)["ok"]
        told = until(lambda: (s := state(socket))["latency_ms_median"] is not None and s)
        assert told["latency_ms"] > 0
        assert told["tracker_ms"] >= 0


@pytest.mark.slow
def test_pictures_come_when_asked_for_with_the_state_of_their_frame(address: str, stream: Stream) -> None:
    with live(address) as socket:
        assert not state(socket)["jpeg"]
        socket.send(json.dumps({"type": "frame"}))
        pictures, states, text = [], [], {}
        end = time.monotonic() + 1
        while time.monotonic() < end or not pictures:
            message = socket.recv(timeout=TIMEOUT_S)
            if isinstance(message, bytes):
                assert text["jpeg"]
                pictures.append(message)
            else:
                text = json.loads(message)
                states.append(text)
        # one was asked for, so one came, however many frames did
        assert (len(pictures), sum(told["jpeg"] for told in states)) == (1, 1)
        image = cv2.imdecode(np.frombuffer(pictures[0], np.uint8), cv2.IMREAD_COLOR)
        assert image.shape == (HEIGHT, WIDTH, 3)
        assert image[95, 120].mean() > 200


@pytest.mark.slow
def test_pictures_for_other_programs(http: httpx.Client) -> None:
    http.post("/api/targets", json={"box": BLOB})
    plain = http.get("/api/frame.jpg")
    assert plain.headers["content-type"] == "image/jpeg"
    assert cv2.imdecode(np.frombuffer(plain.content, np.uint8), cv2.IMREAD_COLOR).shape == (HEIGHT, WIDTH, 3)
    with http.stream("GET", "/api/stream.mjpg") as answer:
        data = b""
        for part in answer.iter_raw():
            data += part
            if data.count(b"--frame") > 3:
                break
    jpeg = data.split(b"\r\n\r\n", 1)[1].split(b"\r\n--frame")[0]
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    # the outline of the box, in green
    assert image[80, 110, 1] > image[80, 110, 2] + 60


@pytest.mark.slow
def test_a_silent_stream_is_told_and_so_is_its_return(
    address: str, stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("psiamfcpp.serve.status._SILENT_S", 0.5)
    with live(address) as socket:
        until(lambda: state(socket)["source"]["state"] == "playing")
        stream.silent = True
        until(lambda: state(socket)["source"]["state"] == "silent")
        stream.silent = False
        until(lambda: state(socket)["source"]["state"] == "playing")


def test_bearings_are_told_where_the_field_of_view_is_known(control: Control) -> None:
    with served(control, fov=60.0) as address, browse(address) as http:
        http.post("/api/targets", json={"box": BLOB})
        (target,) = until(lambda: http.get("/api/state").json()["targets"])
        assert target["bearing"]["azimuth_deg"] < -15
        assert target["bearing"]["elevation_deg"] > 10


@pytest.mark.slow
def test_the_description_names_every_way_in(http: httpx.Client) -> None:
    paths = http.get("/openapi.json").json()["paths"]
    assert paths.keys() == {
        "/api/login",
        "/api/targets",
        "/api/targets/{number}",
        "/api/selected",
        "/api/propose",
        "/api/operator",
        "/api/pause",
        "/api/position",
        "/api/recording",
        "/api/recordings",
        "/api/recordings/{name}/{file}",
        "/api/snapshot.jpg",
        "/api/state",
        "/api/events",
        "/api/frame.jpg",
        "/api/stream.mjpg",
    }


def test_the_page_loads_nothing_from_elsewhere(http: httpx.Client) -> None:
    page = http.get("/")
    assert "default-src 'self'" in page.headers["content-security-policy"]
    for path in ("/", "/page.js", "/page.css"):
        text = http.get(path).text
        assert len(text) > 500
        assert "http://" not in text.replace("http://www.w3.org", "")
        assert "https://" not in text
    # a generated page of documentation would load its own from elsewhere
    assert http.get("/docs").status_code == 404


def test_numbers_in_the_state_are_finite(http: httpx.Client) -> None:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    # NaN and infinities would come as words that JSON has not
    told = json.loads(http.get("/api/state").text, parse_constant=refuse)
    assert isinstance(told["fps"], float) and math.isfinite(told["fps"])


# In a fresh clone the filter is compiled first.
@pytest.mark.parametrize("tracker", ["opencv:mil", pytest.param("dcf:kcf", marks=pytest.mark.slow)])
def test_trackers_that_state_nothing_are_served(stream: Stream, tracker: str) -> None:
    if tracker.startswith("dcf"):
        pytest.importorskip("numba")
    stream.blobs = [BLOB, (520, 380, 30, 40)]
    with Follower(stream.open, TargetPool(tracker)) as follower:
        until(lambda: follower.newest)
        with served(Control(follower)) as address, browse(address) as http:
            for box in stream.blobs:
                assert http.post("/api/targets", json={"box": box}).status_code == 201
            told = until(lambda: len(found := http.get("/api/state").json()["targets"]) == 2 and found)
            assert [(target["id"], target["state"]) for target in told] == [(1, None), (2, None)]
            assert np.abs(np.array([target["box"] for target in told]) - stream.blobs).max() < 20

"""Whom the server obeys: one operator, those with the token, pages of its own."""

from __future__ import annotations

import json
import os
from functools import partial

import httpx
import pytest
from websockets.exceptions import InvalidStatus

from psiamfcpp.errors import UserError
from psiamfcpp.serve.control import Control, Lease
from psiamfcpp.serve.follower import Follower
from psiamfcpp.serve.guard import COOKIE, _cookie, check_address
from psiamfcpp.serve.limits import Buckets

from .conftest import BLOB, TOKEN, Clock, ask, browse, live, served, state, until


@pytest.mark.slow
def test_one_operates_and_others_watch(address: str, http: httpx.Client, follower: Follower) -> None:
    with live(address) as first, live(address) as second:
        assert ask(first, type="start", box=BLOB)["ok"]
        refused = ask(second, type="stop")
        assert refused == {
            "type": "reply",
            "request": 7,
            "ok": False,
            "error": "another client is in control: wait until it hands over or leaves",
        }
        until(lambda: state(second)["operator"] == "other" and state(second)["targets"])
        assert http.delete("/api/targets").status_code == 409
        assert ask(first, type="operator", take=False)["ok"]
        assert ask(second, type="stop")["ok"]
    assert http.post("/api/operator", headers={"X-Client": "me"}).status_code == 409


def test_an_operator_that_comes_back_is_still_one(address: str) -> None:
    with live(address, "pilot") as socket:
        assert ask(socket, type="operator", take=True)["ok"]
    with live(address, "pilot") as socket:
        assert state(socket)["operator"] == "you"


def test_nobody_can_bear_the_name_of_another(address: str, http: httpx.Client, control: Control) -> None:
    assert http.post("/api/operator").status_code == 200
    assert http.get("/api/state").json()["operator"] == "you"
    holder = control.lease.holder
    assert holder == "rest 127.0.0.1"
    assert http.post("/api/operator", headers={"X-Client": holder}).status_code == 409
    with live(address, "rest 127.0.0.1") as socket:
        assert not ask(socket, type="stop")["ok"]


def test_control_is_free_once_its_holder_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psiamfcpp.serve.control.LEASE_S", 15.0)
    clock = Clock()
    lease = Lease(clock)
    assert lease.claim("a")
    clock.now = 14
    assert not lease.claim("b")
    lease.keep("a")
    clock.now = 28
    assert lease.holder == "a"
    clock.now = 30
    assert lease.holder is None
    assert lease.claim("b")
    assert not lease.claim("a")


def test_control_is_handed_over_to_the_one_that_asks_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("psiamfcpp.serve.control.LEASE_S", 15.0)
    clock = Clock()
    lease = Lease(clock)
    assert lease.ask("a")
    assert lease.asking is None
    assert not lease.ask("b")
    assert (lease.holder, lease.asking) == ("a", "b")
    lease.release("b")  # which has nothing to give
    assert lease.holder == "a"
    lease.release("a")
    assert (lease.holder, lease.asking) == ("b", None)
    assert not lease.ask("a")
    clock.now = 10
    lease.keep("b")
    clock.now = 16
    # nobody asks any more
    assert lease.asking is None
    lease.release("b")
    assert lease.holder is None
    # one that asks, and takes what is free later, asks no more
    assert lease.claim("a")
    assert not lease.ask("b")
    clock.now = 32
    assert lease.claim("b")
    assert lease.asking is None


def test_the_one_in_control_sees_that_it_is_asked(address: str) -> None:
    with browse(address, headers={"X-Client": "a"}) as first, browse(address, headers={"X-Client": "b"}) as second:
        assert first.post("/api/operator").status_code == 200
        assert first.get("/api/state").json()["asked"] is False
        refused = second.post("/api/operator")
        assert refused.status_code == 409
        assert "asked to hand over" in refused.json()["error"]
        assert [each.get("/api/state").json()["asked"] for each in (first, second)] == [True, False]
        first.delete("/api/operator")
        assert second.get("/api/state").json()["operator"] == "you"


@pytest.mark.slow
@pytest.mark.parametrize("given", [None, "wrong", TOKEN[:-1], TOKEN + "x", "ü" * 20])
def test_a_wrong_token_opens_nothing(control: Control, given: str | None) -> None:
    headers = {} if given is None else {"Authorization": f"Bearer {given}".encode()}
    with served(control, token=TOKEN) as address:
        with browse(address, headers=headers) as http:
            for method, path in (("GET", "/api/state"), ("POST", "/api/targets"), ("GET", "/openapi.json")):
                answer = http.request(method, path)
                assert (answer.status_code, list(answer.json())) == (401, ["error"])
            assert http.post("/api/login", json={"token": given or ""}).status_code == 401
            assert http.get("/").status_code == 200
        with pytest.raises(InvalidStatus) as refusal:
            live(address, additional_headers={} if given is None else {"Cookie": "psiamfcpp_token=wrong"})
        assert refusal.value.response.status_code == 401


@pytest.mark.slow
def test_the_token_opens_everything(control: Control) -> None:
    with served(control, token=TOKEN) as address:
        with browse(address) as http:
            known = {"Authorization": f"Bearer {TOKEN}"}
            assert http.get("/api/state", headers=known).status_code == 200
            described = http.get("/openapi.json", headers=known).json()
            (name,) = described["security"][0]
            assert described["components"]["securitySchemes"][name] == {"type": "http", "scheme": "bearer"}
            login = http.post("/api/login", json={"token": TOKEN})
            cookie = login.headers["set-cookie"]
            assert "HttpOnly" in cookie
            assert "samesite=strict" in cookie.lower()
            assert http.get("/api/state").status_code == 200
            # with a token, any name may lead here
            assert http.get("/api/state", headers={"Host": "drone.local"}).status_code == 200
        with live(address, additional_headers={"Cookie": cookie.split(";")[0]}) as socket:
            assert state(socket)["frame"] > 0
        with live(address, additional_headers={"Authorization": f"Bearer {TOKEN}"}) as socket:
            assert ask(socket, type="start", box=BLOB)["ok"]


@pytest.mark.parametrize(
    "token",
    [
        "\U0001f680" * 12,
        "p\u00e4ssw\u00f6rter-\u00fcber",
        " " * 12,
        "a" + " " * 20 + "b",
        "long enough it is ",
        " long enough it is",
        "long\tenough it is",
        "long enough\nit is",
        os.fsdecode(b"\xff\xfe long enough it is"),
        "short",
        "",
    ],
)
def test_tokens_that_cannot_be_sent_or_can_be_guessed_are_refused(token: str) -> None:
    for host in ("127.0.0.1", "0.0.0.0"):
        with pytest.raises(UserError, match="the token ") as caught:
            check_address(host, token)
        assert str(caught.value).isascii()
        assert token not in str(caught.value) or not token


@pytest.mark.slow
def test_every_token_that_is_taken_can_be_sent(control: Control) -> None:
    token = "".join(map(chr, range(0x21, 0x7F))) + " and a blank"
    check_address("0.0.0.0", token)
    with served(control, token=token) as address, browse(address) as http:
        assert http.get("/api/state", headers={"Authorization": f"Bearer {token}"}).status_code == 200
        assert http.post("/api/login", json={"token": token}).status_code == 200
        assert http.get("/api/state").status_code == 200
        # also beside the cookies of other servers on this machine
        cookie = f'a="b\\"; other=1; {COOKIE}={http.cookies[COOKIE]}; z'
        http.cookies.clear()
        assert http.get("/api/state", headers={"Cookie": cookie}).status_code == 200
        # what it cannot be is wrong, and no fault
        for wrong in ("\U0001f680" * 12, "\ud800" * 12, "x" * 1000):
            body = json.dumps({"token": wrong})
            answer = http.post("/api/login", content=body, headers={"Content-Type": "application/json"})
            assert answer.status_code in (401, 422)


@pytest.mark.parametrize(
    ("header", "value"),
    [
        ("", ""),
        (f"{COOKIE}=plain", "plain"),
        (f"a=b;{COOKIE}=x=y ; c", "x=y"),
        (f'{COOKIE}="a\\"b\\\\c\\054d\\073e"', 'a"b\\c,d;e'.replace(";", ";")),
        (f'{COOKIE}="', '"'),
        (f'{COOKIE}="\\"', "\\"),
        (f"{COOKIE}x=1; x{COOKIE}=2", ""),
        (f"{COOKIE}", ""),
        ("\\" * 60_000, ""),
        # a minute's work for http.cookies
        (f'{COOKIE}="' + "\\" * 60_000 + '"', "\\" * 30_000),
    ],
)
def test_cookies_are_read_as_they_are_written(header: str, value: str) -> None:
    assert _cookie(header) == value


@pytest.mark.slow
def test_tokens_cannot_be_guessed_at_any_rate(control: Control, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr("psiamfcpp.serve.guard.Buckets", partial(Buckets, clock=clock))
    with served(control, token=TOKEN) as address, browse(address) as http:
        codes = [http.post("/api/login", json={"token": f"wrong {n:08}"}).status_code for n in range(30)]
        assert codes == [401] * 10 + [429] * 20
        # what is not looked at cannot be found right
        refused = http.post("/api/login", json={"token": TOKEN})
        assert (refused.status_code, refused.headers["retry-after"]) == (429, "2")
        assert refused.json() == {"error": "too many wrong tokens: wait some seconds"}
        wrong = {"Authorization": "Bearer wrong but long"}
        assert {http.get("/api/state", headers=wrong).status_code for _ in range(20)} == {429}
        # but whoever has the token is served
        assert http.get("/api/state", headers={"Authorization": f"Bearer {TOKEN}"}).status_code == 200
        # and no other address is held up
        other = httpx.HTTPTransport(local_address="127.0.0.2")
        with browse(address, transport=other) as elsewhere:
            assert elsewhere.post("/api/login", json={"token": TOKEN}).status_code == 200
        clock.now = 2
        assert http.post("/api/login", json={"token": TOKEN}).status_code == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:1", "http://["])
def test_foreign_origins_are_refused(address: str, http: httpx.Client, origin: str, follower: Follower) -> None:
    answer = http.post("/api/targets", json={"box": BLOB}, headers={"Origin": origin})
    assert (answer.status_code, answer.json()) == (403, {"error": "requests from other sites' pages are refused"})
    with pytest.raises(InvalidStatus) as refusal:
        live(address, origin=origin)
    assert refusal.value.response.status_code == 403
    assert follower.newest is not None
    assert not follower.newest.tracks


@pytest.mark.parametrize(
    "headers", [{"Origin": "http://evil.example"}, {"Sec-Fetch-Site": "cross-site"}, {"Sec-Fetch-Site": "same-site"}]
)
def test_other_sites_pages_cannot_even_watch(http: httpx.Client, headers: dict[str, str]) -> None:
    for path in ("/api/state", "/api/frame.jpg", "/api/stream.mjpg", "/page.js"):
        assert http.get(path, headers=headers).status_code == 403
    assert http.get("/api/state", headers={"Sec-Fetch-Site": "same-origin"}).status_code == 200
    # a link to the page is no harm
    assert http.get("/", headers={"Sec-Fetch-Site": "cross-site"}).status_code == 200


def test_the_own_origin_is_welcome(address: str) -> None:
    with live(address, origin=f"http://{address}") as socket:
        assert state(socket)["frame"] > 0


def test_foreign_names_for_this_machine_are_refused(http: httpx.Client) -> None:
    answer = http.get("/api/state", headers={"Host": "evil.example"})
    assert (answer.status_code, answer.json()) == (
        403,
        {"error": "this server answers to this machine's own names only"},
    )

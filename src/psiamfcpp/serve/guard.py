"""What every request must pass before anything looks at it: host, origin, token, size."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
import json
from http.cookies import CookieError, SimpleCookie
from urllib.parse import urlsplit

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from psiamfcpp.errors import UserError
from psiamfcpp.serve.limits import Buckets

COOKIE = "psiamfcpp_token"
MAX_BODY = 16 * 1024
_BODY_S = 10.0
# Guesses at the token, by address: a hand that mistypes needs no more.
_GUESSES_PER_S, _GUESSES_AT_ONCE = 0.5, 10.0
SHORTEST_TOKEN = 12
REFUSALS = {
    401: "a token is needed: send it as 'Authorization: Bearer TOKEN'",
    429: "too many wrong tokens: wait some seconds",
}
# What must be had before a token can be given.
_OPEN_PATHS = {"/", "/page.css", "/page.js", "/api/login"}


def check_address(host: str, token: str | None) -> None:
    """Refuse to listen where others could command without a token.

    Raises:
        UserError: another address than this machine's own, and no token; or a token that can be guessed.
    """
    if token is not None and len(token) < SHORTEST_TOKEN:
        raise UserError(f"the token has {len(token)} characters: give at least {SHORTEST_TOKEN}")
    if token is None and not is_loopback(host):
        raise UserError(f"--host {host} can be reached by others: give a --token that they must know")


def is_loopback(host: str) -> bool:
    """Whether an address or name is this machine's own."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Guard:
    """Middleware that refuses, in one line, what must not come in."""

    def __init__(self, app: ASGIApp, token: str | None):
        self._app = app
        self._token = None if token is None else hashlib.sha256(token.encode()).digest()
        self._guesses = Buckets(_GUESSES_PER_S, _GUESSES_AT_ONCE)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {name.lower(): value.decode("latin-1") for name, value in scope["headers"]}
        refusal = self._refusal(scope, headers)
        if refusal is None:
            await self._app(scope, _limited(receive) if scope["type"] == "http" else receive, send)
        elif scope["type"] == "http":
            await _answer(send, "http.response", *refusal)
        else:
            await receive()  # the handshake
            await _answer(send, "websocket.http.response", *refusal)

    def knows(self, token: str) -> bool:
        """Whether this is the token, compared in a time that tells nothing about it."""
        given = hashlib.sha256(token.encode("utf-8", "replace")).digest()
        return self._token is None or hmac.compare_digest(given, self._token)

    def login(self, token: str, address: str) -> int:
        """Judge an attempt to log in.

        Args:
            token: what was given.
            address: where it came from. After ten wrong tokens one more is looked at every two seconds, right or
                wrong, so that guessing takes for ever; other addresses are not held up.

        Returns:
            200, 401 for a wrong token, or 429.
        """
        if self._guesses.empty(address):
            return 429
        return 200 if self.knows(token) else self._wrong(address)

    def _wrong(self, address: str) -> int:
        return 401 if self._guesses.take(address) else 429

    def _refusal(self, scope: Scope, headers: dict[bytes, str]) -> tuple[int, str] | None:
        host = headers.get(b"host", "")
        # A foreign page whose name was made to lead here still sends its own name.
        if self._token is None and not is_loopback(_hostname(host)):
            return 403, "this server answers to this machine's own names only"
        origin = headers.get(b"origin")
        # Pictures and the like are asked for without an origin, but browsers say from where. A link may lead here.
        site = "none" if scope["path"] == "/" else headers.get(b"sec-fetch-site", "none")
        if (origin is not None and _netloc(origin) != host.lower()) or site not in ("none", "same-origin"):
            return 403, "requests from other sites' pages are refused"
        length = headers.get(b"content-length", "0")
        if not length.isdecimal() or int(length) > MAX_BODY:
            return 413, f"a request may hold {MAX_BODY} bytes"
        if self._token is None or scope["path"] in _OPEN_PATHS:
            return None
        token = _token(headers)
        # One with the right token is never refused for the guesses of others at its address.
        if self.knows(token):
            return None
        code = self._wrong(_address(scope)) if token else 401
        return code, REFUSALS[code]


def _address(scope: Scope) -> str:
    client = scope.get("client")
    return str(client[0]) if client else ""


def _hostname(host: str) -> str:
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _netloc(origin: str) -> str:
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


def _token(headers: dict[bytes, str]) -> str:
    kind, _, token = headers.get(b"authorization", "").partition(" ")
    if kind.lower() == "bearer":
        return token.strip()
    try:
        morsel = SimpleCookie(headers.get(b"cookie", "")).get(COOKIE)
    except CookieError:
        morsel = None
    return morsel.value if morsel else ""


def _limited(receive: Receive) -> Receive:
    """The same body, cut off where it is longer than is allowed, or does not come."""
    size, whole = 0, False

    async def take() -> Message:
        nonlocal size, whole
        try:
            # once it is there, the next message is that the client left
            message = await asyncio.wait_for(receive(), None if whole else _BODY_S)
        except asyncio.TimeoutError:
            return {"type": "http.disconnect"}
        whole = not message.get("more_body", False)
        size += len(message.get("body", b""))
        return {"type": "http.disconnect"} if size > MAX_BODY else message

    return take


async def _answer(send: Send, kind: str, code: int, text: str) -> None:
    body = json.dumps({"error": text}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    if code == 429:
        headers.append((b"retry-after", b"2"))
    if code == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    await send({"type": f"{kind}.start", "status": code, "headers": headers})
    await send({"type": f"{kind}.body", "body": body})

"""What every request must pass before anything looks at it: host, origin, token, size."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
import json
import re
from urllib.parse import urlsplit

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from psiamfcpp.errors import UserError
from psiamfcpp.serve.gate import Gate
from psiamfcpp.serve.limits import Buckets

COOKIE = "psiamfcpp_token"
MAX_BODY = 16 * 1024
_BODY_S = 10.0
# Guesses at the token, by address: a hand that mistypes needs no more.
_GUESSES_PER_S, _GUESSES_AT_ONCE = 0.5, 10.0
SHORTEST_TOKEN = 12
REFUSALS = {
    401: "a token is needed: send it as 'Authorization: Bearer TOKEN'",
    408: "the request did not come in time",
    413: f"a request may hold {MAX_BODY} bytes",
    429: "too many wrong tokens: wait some seconds",
}
# As `Set-Cookie` writes what a cookie cannot hold as it is.
_ESCAPED = re.compile(r"\\([0-3][0-7]{2}|\D)")
# What must be had before a token can be given.
_OPEN_PATHS = {"/", "/page.css", "/page.js", "/view.js", "/choose.js", "/api/login", "/api/enter"}


def check_address(host: str, token: str | None) -> None:
    """Refuse to listen where others could command without a token.

    Raises:
        UserError: another address than this machine's own, and no token; or a token that can be guessed, or that
            headers cannot carry as it is.
    """
    if token is not None:
        # Other letters are sent in several ways, and blanks at the ends are lost.
        if not (token.isascii() and token.isprintable()) or token != token.strip():
            raise UserError("the token holds what cannot be sent: give visible ASCII characters, no blank at its ends")
        visible = len(token.replace(" ", ""))
        if visible < SHORTEST_TOKEN:
            raise UserError(f"the token has {visible} characters: give at least {SHORTEST_TOKEN} besides blanks")
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
        self.gate = Gate()
        self._guesses = Buckets(_GUESSES_PER_S, _GUESSES_AT_ONCE)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        with self.gate.serving(_client(scope)):
            await self._serve(scope, receive, send)

    async def _serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = {name.lower(): value.decode("latin-1") for name, value in scope["headers"]}
        refusal = self._refusal(scope, headers)
        web = scope["type"] == "http"
        if refusal is None and web:
            body = await _whole(receive)
            if isinstance(body, int):
                refusal = body, REFUSALS[body]
            else:
                receive = _again(body, receive)
        if refusal is None:
            if self.knows(_token(headers)):
                self.gate.prove(_client(scope))
            await self._app(scope, receive, send)
        elif web:
            await _answer(send, "http.response", *refusal)
        else:
            await receive()  # the handshake
            await _answer(send, "websocket.http.response", *refusal)

    def knows(self, token: str) -> bool:
        """Whether this is the token, compared in a time that says nothing about it."""
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
        # Images and the like are asked for without an origin, but browsers say from where. A link may lead here.
        site = "none" if scope["path"] == "/" else headers.get(b"sec-fetch-site", "none")
        if (origin is not None and _netloc(origin) != host.lower()) or site not in ("none", "same-origin"):
            return 403, "requests from other sites' pages are refused"
        length = headers.get(b"content-length", "0")
        if not length.isdecimal() or int(length) > MAX_BODY:
            return 413, REFUSALS[413]
        if self._token is None or scope["path"] in _OPEN_PATHS:
            return None
        token = _token(headers)
        # One with the right token is never refused for the guesses of others at its address.
        if self.knows(token):
            return None
        code = self._wrong(_client(scope)[0]) if token else 401
        return code, REFUSALS[code]


def _client(scope: Scope) -> tuple[str, int]:
    client = scope.get("client")
    return (client[0], client[1]) if client else ("", 0)


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
    return _cookie(headers.get(b"cookie", ""))


def _cookie(header: str) -> str:
    """Return the value of our cookie, or nothing.

    Not with `http.cookies`: many of its releases take a minute of the server's loop for 60,000 backslashes.
    """
    for part in header.split(";"):
        name, _, value = part.strip().partition("=")
        if name == COOKIE:
            quoted = len(value) > 1 and value[0] == value[-1] == '"'
            return _ESCAPED.sub(_unescaped, value[1:-1]) if quoted else value
    return ""


def _unescaped(found: re.Match[str]) -> str:
    return chr(int(found[1], 8)) if found[1].isdigit() else found[1]


async def _whole(receive: Receive) -> bytes | int:
    """Return the body of a request, or 408 or 413 where it does not come in time, or is longer than is allowed."""
    body = b""
    end = asyncio.get_running_loop().time() + _BODY_S
    while True:
        try:
            # for all of it: each byte would else buy more time
            message = await asyncio.wait_for(receive(), end - asyncio.get_running_loop().time())
        except asyncio.TimeoutError:
            return 408
        if message["type"] == "http.disconnect":  # nobody is left to answer, nor to act for
            return 408
        body += message.get("body", b"")
        if len(body) > MAX_BODY:
            return 413
        if not message.get("more_body", False):
            return body


def _again(body: bytes, receive: Receive) -> Receive:
    """What gives a body that was received already, and then what comes after it."""
    given = False

    async def take() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return take


async def _answer(send: Send, kind: str, code: int, text: str) -> None:
    body = json.dumps({"error": text}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    if code in (408, 413):  # the rest of the body is not read
        headers.append((b"connection", b"close"))
    if code == 429:
        headers.append((b"retry-after", b"2"))
    if code == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    await send({"type": f"{kind}.start", "status": code, "headers": headers})
    await send({"type": f"{kind}.body", "body": body})

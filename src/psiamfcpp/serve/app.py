"""The page and its API."""

from __future__ import annotations

import contextlib
import secrets
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, Any

from fastapi import FastAPI, Header, HTTPException, Path, Query, Request, Response, WebSocket
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse, StreamingResponse
from starlette.exceptions import HTTPException as StarletteHTTPException

from psiamfcpp.errors import UserError
from psiamfcpp.serve import guard, messages
from psiamfcpp.serve.control import Control, NotOperatorError, TooManyError
from psiamfcpp.serve.follower import BusyError
from psiamfcpp.serve.live import MAX_CLIENTS, Client, Room, start
from psiamfcpp.serve.pages import HEADERS, add_files
from psiamfcpp.serve.pictures import Pictures, annotated, jpeg, plain
from psiamfcpp.serve.recordings import find, listed
from psiamfcpp.version import __version__

_BOUNDARY = "frame"
_PAGE = {"/": "index.html", "/page.js": "page.js", "/view.js": "view.js", "/page.css": "page.css"}
_ABOUT = """
Follow targets in a live video. Start one with `POST /api/targets`, watch it on the WebSocket `/api/live`.

**WebSocket `/api/live`** (`?client=NAME` names the client; a name that comes back within 15 seconds keeps control).
The server sends JSON: `{"type": "state", ...}` for every frame that the client has time for (it gets the next
when it has read all but the last few messages, so answer pings, as every library does), with the fields of
`GET /api/state`, and `events` (new ones), `latency_ms` (from reading this frame to sending its box; null when the frame
was sent before) and `jpeg` (whether a binary message with the image of this very frame follows).
The client sends JSON:

* `{"type": "frame"}`: send one more image; a client that asks again when it has shown one is never behind
* `{"type": "start", "box": [x, y, w, h]}` or `{"type": "start", "point": [x, y]}`; with `"frame"`, the `frame` of the
  state that it was drawn on, the target catches up from there; with `"replace"`, another target is stopped for it
* `{"type": "hold", "frame": 71}`: keep this frame while I draw, for two minutes at most; without `frame`, no more
* `{"type": "stop", "id": 1}`, without `id` all
* `{"type": "select", "id": 1}`, `{"type": "propose", "point": [x, y]}`
* `{"type": "operator", "take": true}`, `{"type": "record", "on": true}`
* of files: `{"type": "pause", "on": true}`, `{"type": "seek", "frame": 250}`

and gets `{"type": "reply", "request": ..., "ok": ...}` with `error` where it was refused; `request` is whatever whole
number the message held under that name.

**One operator.** Whoever commands first is in control until it hands over (`DELETE /api/operator`), or gives no sign of
life for 15 seconds; others get 409. One that takes control meanwhile (`POST /api/operator`) asks for it: for 15 seconds
`asked` is true in the state of the one in control, and handing over gives control to the one that asks. Over REST, the
header `X-Client` names the client.

**Token.** Where the server was started with one: `Authorization: Bearer TOKEN`, or the cookie that `POST /api/login`
sets.
"""
# Its schema and not the class, of which FastAPI would make a model anew for each code of each route.
_REFUSAL = messages.Refusal.model_json_schema()
_REFUSALS: dict[int | str, dict[str, Any]] = {
    code: {"description": what, "content": {"application/json": {"schema": _REFUSAL}}}
    for code, what in {
        401: "no token, or a wrong one",
        403: "a foreign host or origin",
        409: "another client is in control",
        413: "too long",
        422: "wrong values",
        429: "too often",
        503: "not now",
    }.items()
}
ClientName = Annotated[str | None, Header(alias="X-Client", max_length=100)]


def build_app(control: Control, *, token: str | None = None, fov: float | None = None) -> guard.Guard:
    """The server as an ASGI application.

    Args:
        control: what is served.
        token: what clients must know; None for this machine's own clients only.
        fov: horizontal field of view of the camera, degrees, if known.
    """
    executor = ThreadPoolExecutor(4, "serve")
    room = Room(control, fov, Pictures(plain, executor), executor)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        room.bell.open()
        control.follower.listeners.append(room.bell.ring)
        yield
        control.follower.listeners.remove(room.bell.ring)
        room.bell.close()
        executor.shutdown(wait=False, cancel_futures=True)

    app = FastAPI(
        title="P-SiamFC++",
        version=__version__,
        description=_ABOUT,
        lifespan=lifespan,
        docs_url=None,  # their assets come from elsewhere
        redoc_url=None,
        responses=_REFUSALS,
    )
    app.state.room = room
    guarded = guard.Guard(app, token)
    add_refusals(app)
    _add_page(app, guarded)
    _add_commands(app, room)
    _add_views(app, room, Pictures(annotated, executor))
    if token is not None:
        # what the guard asks for, said where generated clients look for it
        described = app.openapi()
        described["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
        described["security"] = [{"token": []}]
    return guarded


def add_refusals(app: FastAPI) -> None:
    """Have an application answer what it refuses with ``{"error": "one line"}``."""

    def refuse(code: int) -> Callable[[Request, Exception], JSONResponse]:
        headers = {"Retry-After": "1"} if code in (429, 503) else {}
        return lambda _, error: JSONResponse({"error": " ".join(str(error).split())}, code, headers)

    for kind, code in ((UserError, 422), (NotOperatorError, 409), (TooManyError, 429), (BusyError, 503)):
        app.add_exception_handler(kind, refuse(code))

    async def invalid(_: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, RequestValidationError)
        first = error.errors()[0]
        # what was sent is not sent back: it may be anything, and long
        place = ".".join(str(part) for part in first["loc"][1:])
        return JSONResponse({"error": f"{place + ': ' if place else ''}{first['msg']}"}, 422)

    async def other(_: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, StarletteHTTPException)
        return JSONResponse({"error": str(error.detail)}, error.status_code, error.headers)

    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(StarletteHTTPException, other)


def _add_page(app: FastAPI, guarded: guard.Guard) -> None:
    add_files(app, _PAGE)

    @app.post("/api/login", response_model=messages.Done, tags=["access"])
    async def login(body: messages.LoginBody, request: Request, response: Response) -> dict[str, bool]:
        """Get a cookie for the token. After ten wrong ones from an address, one is looked at every two seconds."""
        code = guarded.login(body.token, request.client.host if request.client else "")
        if code == 401:
            raise HTTPException(401, "the token is wrong")
        if code == 429:
            raise HTTPException(429, guard.REFUSALS[429], {"Retry-After": "2"})
        response.set_cookie(guard.COOKIE, body.token, httponly=True, samesite="strict", path="/")
        return {"ok": True}


def _named(given: str) -> str:
    """What a client that gave itself a name is known as: nobody else, such as a ground station, can be meant by it."""
    return f"named {given}"


def _name(request: Request, given: str | None) -> str:
    return _named(given) if given else f"rest {request.client.host if request.client else ''}"


def _add_commands(app: FastAPI, room: Room) -> None:
    control = room.control

    @app.post("/api/targets", status_code=201, response_model=messages.Started, tags=["targets"])
    async def start_target(body: messages.StartBody, request: Request, client: ClientName = None) -> dict[str, Any]:
        """Follow one more target, given its box or a point on it."""
        number, box = await start(room, _name(request, client), body)
        return {"id": number, "box": box}

    @app.delete("/api/targets/{number}", response_model=messages.Done, tags=["targets"])
    async def stop_target(
        number: Annotated[int, Path(ge=1, le=10**9)], request: Request, client: ClientName = None
    ) -> dict[str, bool]:
        """Stop a target."""
        await room.run(control.stop, _name(request, client), number)
        return {"ok": True}

    @app.delete("/api/targets", response_model=messages.Done, tags=["targets"])
    async def stop_all(request: Request, client: ClientName = None) -> dict[str, bool]:
        """Stop all targets."""
        await room.run(control.stop, _name(request, client))
        return {"ok": True}

    @app.put("/api/selected", response_model=messages.Done, tags=["targets"])
    async def select(body: messages.SelectBody, request: Request, client: ClientName = None) -> dict[str, bool]:
        """Choose the target that MAVLink speaks of."""
        await room.run(control.select, _name(request, client), body.id)
        return {"ok": True}

    @app.post("/api/propose", response_model=messages.Proposal, tags=["targets"])
    async def propose(body: messages.PointBody, request: Request, client: ClientName = None) -> dict[str, Any]:
        """The box that a point would be given."""
        return {"box": await room.run(control.propose, _name(request, client), *body.point)}

    @app.post("/api/operator", response_model=messages.Done, tags=["access"])
    async def take(request: Request, client: ClientName = None) -> dict[str, bool]:
        """Take control, say that one still wants it, or ask the client in control to hand over."""
        control.take(_name(request, client))
        return {"ok": True}

    @app.delete("/api/operator", response_model=messages.Done, tags=["access"])
    async def hand_over(request: Request, client: ClientName = None) -> dict[str, bool]:
        """Hand control over to whoever commands next."""
        control.lease.release(_name(request, client))
        return {"ok": True}

    @app.post("/api/pause", response_model=messages.Done, tags=["playing"])
    async def pause(request: Request, client: ClientName = None) -> dict[str, bool]:
        """Stop playing a file at its next frame."""
        await room.run(control.pause, _name(request, client), True)
        return {"ok": True}

    @app.delete("/api/pause", response_model=messages.Done, tags=["playing"])
    async def play(request: Request, client: ClientName = None) -> dict[str, bool]:
        """Play a file on."""
        await room.run(control.pause, _name(request, client), False)
        return {"ok": True}

    @app.put("/api/position", response_model=messages.Done, tags=["playing"])
    async def seek(body: messages.SeekBody, request: Request, client: ClientName = None) -> dict[str, bool]:
        """Play a file from another frame on; targets are stopped."""
        await room.run(control.seek, _name(request, client), body.frame)
        return {"ok": True}

    @app.post("/api/recording", response_model=messages.Done, tags=["recording"])
    async def record(request: Request, client: ClientName = None) -> dict[str, bool]:
        """Begin to record video and boxes."""
        await room.run(control.record, _name(request, client), True)
        return {"ok": True}

    @app.delete("/api/recording", response_model=messages.Done, tags=["recording"])
    async def stop_recording(request: Request, client: ClientName = None) -> dict[str, bool]:
        """End the recording."""
        await room.run(control.record, _name(request, client), False)
        return {"ok": True}


def _add_views(app: FastAPI, room: Room, drawn: Pictures) -> None:
    follower = room.control.follower

    @app.get("/api/state", response_model=messages.State, response_model_exclude_unset=True, tags=["watching"])
    async def state(request: Request, client: ClientName = None) -> dict[str, Any]:
        """Return the current state."""
        return room.state(_name(request, client))

    @app.get("/api/events", response_model=list[messages.EventOut], tags=["watching"])
    async def events(after: Annotated[int, Query(ge=0)] = 0) -> list[Any]:
        """The last 200 events, of those with a number above `after`."""
        return follower.events(after)

    @app.get("/api/frame.jpg", response_class=Response, tags=["watching"])
    async def frame() -> Response:
        """The newest frame, as the camera gave it."""
        if follower.newest is None:
            raise BusyError("no frame has come yet: try again")
        return Response(await room.pictures.get(follower.newest), media_type="image/jpeg", headers=HEADERS)

    @app.get("/api/snapshot.jpg", response_class=Response, tags=["watching"])
    async def snapshot(boxes: bool = True) -> Response:
        """The newest frame in its full size, to keep; with what was found in it."""
        shot = follower.newest
        if shot is None:
            raise BusyError("no frame has come yet: try again")
        data = await room.run(lambda: jpeg(annotated(shot) if boxes else shot.image, None, 95))
        name = time.strftime(f"psiamfcpp-%Y%m%d-%H%M%S-{shot.number}.jpg")
        headers = {**HEADERS, "Content-Disposition": f'attachment; filename="{name}"'}
        return Response(data, media_type="image/jpeg", headers=headers)

    @app.get("/api/stream.mjpg", response_class=StreamingResponse, tags=["watching"])
    async def stream() -> StreamingResponse:
        """The frames with boxes drawn, as MJPEG; for players and other programs."""
        _check_room(room)
        kind = f"multipart/x-mixed-replace; boundary={_BOUNDARY}"
        return StreamingResponse(_parts(room, drawn), media_type=kind, headers=HEADERS)

    @app.get("/api/recordings", response_model=list[messages.Recording], tags=["recording"])
    async def recordings() -> list[dict[str, Any]]:
        """The recordings that can be fetched, newest first."""
        recorder = room.control.recorder
        return [] if recorder is None else await room.run(listed, recorder.folder)

    @app.get("/api/recordings/{name}/{file}", response_class=FileResponse, tags=["recording"])
    async def recorded(name: str, file: str) -> FileResponse:
        """A file of a recording."""
        recorder = room.control.recorder
        path = None if recorder is None else await room.run(find, recorder.folder, name, file)
        if path is None:
            raise HTTPException(404, "there is no such file of a recording")
        return FileResponse(path, filename=f"{name}-{file}", headers=HEADERS)

    @app.websocket("/api/live")
    async def live(socket: WebSocket, client: str = "") -> None:
        try:
            connection = _enter(room)
        except BusyError as error:
            await socket.send_denial_response(JSONResponse({"error": str(error)}, 503))
            return
        try:
            await socket.accept()
            await Client(socket, room, _named(client[:100]) if client else f"live {connection}").run()
        finally:
            room.clients.discard(connection)


def _check_room(room: Room) -> None:
    if len(room.clients) >= MAX_CLIENTS:
        raise BusyError(f"{MAX_CLIENTS} clients are connected already: try again later")


def _enter(room: Room) -> str:
    """Count a client in; its name."""
    _check_room(room)
    name = secrets.token_hex(8)
    room.clients.add(name)
    return name


async def _parts(room: Room, drawn: Pictures) -> AsyncIterator[bytes]:
    name, shown = _enter(room), None
    try:
        while not room.bell.closed:
            shot = room.control.follower.newest
            if shot is not None and shot is not shown:
                shown = shot
                data = await drawn.get(shot)
                head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                yield head.encode() + data + b"\r\n"
            await room.bell.wait(60.0)
    finally:
        room.clients.discard(name)

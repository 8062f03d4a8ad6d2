"""One client of the WebSocket: it gets every frame that it has time for, and gives commands."""

from __future__ import annotations

import asyncio
import contextlib
import json
import statistics
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import asdict
from typing import Any

from fastapi import WebSocket, WebSocketDisconnect
from pydantic import ValidationError

from psiamfcpp.errors import UserError
from psiamfcpp.serve import messages
from psiamfcpp.serve.control import Control
from psiamfcpp.serve.follower import Shot
from psiamfcpp.serve.limits import Bucket
from psiamfcpp.serve.pace import caught_up
from psiamfcpp.serve.pictures import Pictures
from psiamfcpp.serve.status import status

MAX_CLIENTS = 16
# After this time without news, in seconds, a client gets the same state again, so that it knows that the link holds.
_HEARTBEAT_S = 1.0
# One that takes nothing for so long is gone.
_SEND_S = 20.0
# Each wish for a frame is a message too.
_MESSAGES_PER_S, _MESSAGES_AT_ONCE = 150.0, 300.0
_MOST_MISTAKES = 50
_MOST_WISHES = 3


class Bell:
    """Wakes all who wait; rung from any thread."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._event = asyncio.Event()
        self.closed = False

    def open(self) -> None:
        """Belong to the running loop."""
        self._loop = asyncio.get_running_loop()

    def ring(self) -> None:
        """Wake all who wait now."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._wake)

    async def wait(self, timeout: float) -> None:
        """Until it rings, or the time is over."""
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._event.wait(), timeout)

    def close(self) -> None:
        """Wake all for the last time."""
        self.closed = True
        self._wake()

    def _wake(self) -> None:
        event, self._event = self._event, asyncio.Event()
        event.set()


class Room:
    """What all clients share."""

    def __init__(self, control: Control, fov: float | None, pictures: Pictures, executor: Executor):
        self.control, self.fov, self.pictures, self.executor = control, fov, pictures, executor
        self.bell = Bell()
        self.clients: set[str] = set()
        # of the same frames, so that the two agree: the tracker's time is part of the latency
        self._times: deque[tuple[float, float]] = deque(maxlen=60)

    async def run(self, work: Callable[..., Any], *args: Any) -> Any:
        """Run a command outside of the server's loop, for it waits for the tracker."""
        return await asyncio.get_running_loop().run_in_executor(self.executor, work, *args)

    def sent(self, latency_ms: float, shot: Shot) -> None:
        """Count boxes that were sent; frames without a target took no tracking, and say nothing about it."""
        if shot.tracks:
            self._times.append((latency_ms, 1000 * shot.tracker_s))

    def state(self, client: str) -> dict[str, Any]:
        """Return the state that a client gets; see `messages.State`."""
        whole = status(self.control, client, self.fov)
        if not whole["targets"]:
            self._times.clear()
        latency, tracker = (_median(each) for each in zip(*self._times, strict=True)) if self._times else (None, None)
        return {**whole, "clients": len(self.clients), "latency_ms_median": latency, "tracker_ms_median": tracker}


def _median(values: tuple[float, ...]) -> float:
    return round(statistics.median(values), 1)


class Client:
    """One connection."""

    def __init__(self, socket: WebSocket, room: Room, name: str):
        self._socket, self._room, self._name = socket, room, name
        self._wishes = 0
        self._bucket = Bucket(_MESSAGES_PER_S, _MESSAGES_AT_ONCE)
        self._mistakes = 0
        # one answer may not come between a state and its image
        self._sending = asyncio.Lock()

    async def run(self) -> None:
        """Serve it until it leaves."""
        tasks = {asyncio.create_task(self._tell()), asyncio.create_task(self._hear())}
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._room.control.follower.ring.release(self._name)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        for task in done:
            error = None if task.cancelled() else task.exception()
            if error is not None and not isinstance(error, (WebSocketDisconnect, asyncio.TimeoutError, RuntimeError)):
                raise error
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            await self._socket.close()

    async def _tell(self) -> None:
        room, follower = self._room, self._room.control.follower
        sent = pictured = events = 0
        last = None
        ready = caught_up(self._socket)
        while not room.bell.closed:
            await asyncio.wait_for(ready(), _SEND_S)
            shot = follower.newest
            room.control.lease.keep(self._name)
            state = {"type": "state", **room.state(self._name), "latency_ms": None, "jpeg": False}
            picture = None
            if shot is not None and shot.number > pictured and self._wishes:
                picture = shot
                state["jpeg"] = True
            fresh = follower.events(events)[-20:]
            events = fresh[-1].number if fresh else events
            state["events"] = [asdict(event) for event in fresh]
            async with self._sending:
                if shot is not None and shot.number > sent:
                    sent = shot.number
                    state["latency_ms"] = round(1000 * (time.perf_counter() - shot.read_at), 2)
                    room.sent(state["latency_ms"], shot)
                await self._send(json.dumps(state))
                if picture is not None:
                    pictured, self._wishes = picture.number, self._wishes - 1
                    await self._send(await room.pictures.get(picture))
            last = shot
            if follower.newest is last:
                await room.bell.wait(_HEARTBEAT_S)

    async def _hear(self) -> None:
        while True:
            message = await self._socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            if not self._bucket.take():
                if not await self._refuse("too many messages"):
                    return
                continue
            text = message.get("text")
            try:
                parsed = messages.MESSAGE.validate_json(text if text is not None else b"")
            except ValidationError as error:
                if not await self._refuse(one_line(error), request_of(text)):
                    return
                continue
            if isinstance(parsed, messages.FrameWish):
                self._wishes = min(self._wishes + 1, _MOST_WISHES)
                continue
            await self._obey(parsed)

    async def _obey(self, command: messages.Command) -> None:
        try:
            answer = await self._carry_out(command)
        except UserError as error:
            await self._refuse(str(error), command.request, harmless=True)
            return
        await self._send_locked({"type": "reply", "request": command.request, "ok": True, **answer})

    async def _carry_out(self, command: messages.Command) -> dict[str, Any]:
        control, run, name = self._room.control, self._room.run, self._name
        match command:
            case messages.StartMessage():
                number, box = await start(self._room, name, command)
                return {"id": number, "box": box}
            case messages.StopMessage():
                await run(control.stop, name, command.id)
            case messages.SelectMessage():
                await run(control.select, name, command.id)
            case messages.ProposeMessage():
                return {"box": await run(control.propose, name, *command.point)}
            case messages.OperatorMessage():
                if command.take:
                    control.take(name)
                else:
                    control.lease.release(name)
            case messages.RecordMessage():
                await run(control.record, name, command.on)
            case messages.HoldMessage():
                control.hold(name, command.frame)
            case messages.PauseMessage():
                await run(control.pause, name, command.on)
            case messages.SeekMessage():
                await run(control.seek, name, command.frame)
        return {}

    async def _refuse(self, reason: str, request: int | None = None, harmless: bool = False) -> bool:
        """Say why not; False once there were too many mistakes, and the client is sent away."""
        self._mistakes += not harmless
        if self._mistakes > _MOST_MISTAKES:
            with contextlib.suppress(RuntimeError):
                await self._socket.close(1008, "too many mistakes")
            return False
        await self._send_locked({"type": "reply", "request": request, "ok": False, "error": reason})
        return True

    async def _send_locked(self, answer: dict[str, Any]) -> None:
        async with self._sending:
            await self._send(json.dumps(answer))

    async def _send(self, data: str | bytes) -> None:
        send = self._socket.send_text(data) if isinstance(data, str) else self._socket.send_bytes(data)
        await asyncio.wait_for(send, _SEND_S)


async def start(room: Room, client: str, body: messages.StartBody) -> tuple[int, messages.Box]:
    """Follow the box or the point that was given."""
    if (body.box is None) == (body.point is None):
        raise UserError("give a box or a point, one of the two")
    if body.box is not None:
        return await room.run(room.control.start, client, body.box, body.frame, body.replace)
    assert body.point is not None
    return await room.run(room.control.start_at, client, *body.point, body.frame, body.replace, False)


def request_of(text: str | None) -> int | None:
    """The number by which a client distinguishes its messages, of one that is wrong otherwise."""
    try:
        found = json.loads(text or "")["request"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    return found if isinstance(found, int) and not isinstance(found, bool) else None


def one_line(error: ValidationError) -> str:
    """What is wrong with a message, first things first."""
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    place = ".".join(str(part) for part in first["loc"])
    return f"message refused: {place + ': ' if place else ''}{first['msg']}"

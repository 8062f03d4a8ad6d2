"""What clients may send, with its limits; and what the API answers, for its documentation."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

# No camera has more pixels a side; beyond, a number is a mistake.
Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e5, le=1e5)]
Identifier = Annotated[int, Field(ge=1, le=10**9)]
FrameNumber = Annotated[int, Field(ge=0, le=10**9)]
Box = tuple[Number, Number, Number, Number]
Point = tuple[Number, Number]


class Strict(BaseModel):
    """What a client sends: no field that is not known."""

    model_config = ConfigDict(extra="forbid")


class StartBody(Strict):
    """A target: its box, or a point on it. Pixels of the frame, 0-based."""

    box: Box | None = Field(None, description="x, y, w, h")
    point: Point | None = Field(None, description="x, y; a box is proposed there")
    frame: FrameNumber | None = Field(
        None, description="number of the frame that this was drawn on, as in `State.frame`; by default the newest"
    )
    replace: Identifier | None = Field(None, description="a target that is stopped once this one is followed")


class PointBody(Strict):
    """A point of the frame."""

    point: Point = Field(description="x, y in pixels, 0-based")


class SelectBody(Strict):
    """A choice among the targets."""

    id: Identifier


class SeekBody(Strict):
    """A frame of a file."""

    frame: FrameNumber = Field(description="its number, from 0")


class LoginBody(Strict):
    """The token that the server was started with."""

    token: str = Field(max_length=1000)


class Bearing(BaseModel):
    """Direction from the camera's axis, given the camera's field of view."""

    azimuth_deg: float = Field(description="right is positive")
    elevation_deg: float = Field(description="up is positive")


class Target(BaseModel):
    """A target in the newest frame."""

    id: int
    box: Box = Field(description="x, y, w, h in pixels of the frame, 0-based")
    score: float | None = Field(
        description="calibrated probability that the target is in the box, 0..1; of a tracker without states its own "
        "score, and null where it has none"
    )
    state: Literal["tracking", "unsure", "lost"] | None = Field(description="null where the tracker states none")
    bearing: Bearing | None = Field(None, description="only with --fov")


class Source(BaseModel):
    """Where frames come from."""

    name: str
    state: Literal["playing", "paused", "silent"] = Field(
        description="silent: no frame for two seconds; it is being reopened"
    )
    live: bool = Field(description="a camera or stream, which can be neither paused nor wound")
    frame: int | None = Field(description="of a file: number of the frame that was read last, from 0")
    frames: int | None = Field(description="of a file: how many its container promises, if it does")
    fps: float = Field(description="frames per second of the source itself")
    age_ms: float | None = Field(description="since the last frame was read")


class State(BaseModel):
    """The newest moment."""

    frame: int = Field(description="frames looked at so far")
    width: int
    height: int
    fps: float = Field(description="frames looked at in a second, of late")
    tracker_ms: float | None = Field(description="time that tracking took in this frame; null without targets")
    source: Source
    targets: list[Target]
    selected: int | None = Field(description="the target that MAVLink speaks of")
    operator: Literal["none", "you", "other"] = Field(description="who is in control")
    asked: bool = Field(description="you are in control, and another client asks for it")
    recording: bool | None = Field(description="null where recording was not allowed with --record")
    clients: int = Field(description="programs and pages connected to /api/live")
    latency_ms_median: float | None = Field(
        description="of the last 60 frames sent with a box: from reading the frame to sending the box"
    )
    tracker_ms_median: float | None = Field(description="of the same frames: what tracking took of that time")


class Started(BaseModel):
    """A target that is now followed."""

    id: int
    box: Box


class Proposal(BaseModel):
    """A box for a point."""

    box: Box


class RecordedFile(BaseModel):
    """A file of a recording."""

    name: str
    bytes: int


class Recording(BaseModel):
    """A recording that is finished, or what is left of one."""

    name: str
    files: list[RecordedFile] = Field(description="at /api/recordings/RECORDING/FILE")


class EventOut(BaseModel):
    """Something that happened."""

    number: int
    time: float = Field(description="seconds since 1970")
    text: str


class Done(BaseModel):
    """Nothing more to say."""

    ok: Literal[True] = True


class Refusal(BaseModel):
    """Why not, in one line."""

    error: str


class FrameWish(Strict):
    """Send the JPEG of the next frame that I have not had."""

    type: Literal["frame"]


class StartMessage(StartBody):
    """Follow a target."""

    type: Literal["start"]
    request: int | None = None


class HoldMessage(Strict):
    """Keep a frame while I draw on it; without one, none any more."""

    type: Literal["hold"]
    frame: FrameNumber | None = None
    request: int | None = None


class PauseMessage(Strict):
    """Stop playing a file, or go on."""

    type: Literal["pause"]
    on: bool
    request: int | None = None


class SeekMessage(SeekBody):
    """Play a file from another frame on."""

    type: Literal["seek"]
    request: int | None = None


class StopMessage(Strict):
    """Stop a target; without an id, all."""

    type: Literal["stop"]
    id: Identifier | None = None
    request: int | None = None


class SelectMessage(SelectBody):
    """Choose the target that MAVLink speaks of."""

    type: Literal["select"]
    request: int | None = None


class ProposeMessage(PointBody):
    """Ask for the box that a point would be given."""

    type: Literal["propose"]
    request: int | None = None


class OperatorMessage(Strict):
    """Take control, or hand it over."""

    type: Literal["operator"]
    take: bool
    request: int | None = None


class RecordMessage(Strict):
    """Begin or end a recording."""

    type: Literal["record"]
    on: bool
    request: int | None = None


Command = (
    StartMessage
    | StopMessage
    | SelectMessage
    | ProposeMessage
    | OperatorMessage
    | RecordMessage
    | HoldMessage
    | PauseMessage
    | SeekMessage
)
MESSAGE: TypeAdapter[FrameWish | Command] = TypeAdapter(Annotated[FrameWish | Command, Field(discriminator="type")])

"""What every tracker of this package looks like from outside."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from numpy.typing import ArrayLike

from psiamfcpp.geometry import Box, Image

State = Literal["tracking", "unsure", "lost"]
STATES: tuple[State, ...] = ("tracking", "unsure", "lost")


@dataclass(frozen=True, slots=True)
class Track:
    """The target in one frame. What a tracker cannot say is None, never invented."""

    box: Box
    """``(x, y, w, h)``, pixels, 0-based; while lost the best guess"""
    score: float | None = None
    """how sure the tracker is; its scale is the tracker's own, see there"""
    state: State | None = None
    """tracking, unsure or lost"""


class Tracker(Protocol):
    """Follows one target from frame to frame."""

    @property
    def name(self) -> str:
        """Short name, as tables and result folders show it."""
        ...

    @property
    def identity(self) -> Mapping[str, Any]:
        """Everything that decides the boxes, as JSON values: kind, options and the checksum of model files.

        Two trackers with equal identities give equal boxes. Threads and file locations are not part of it.
        """
        ...

    def init(self, frame: Image, box: ArrayLike) -> Track:
        """Start to follow a target; replaces the target before.

        Args:
            frame: ``(H, W, 3)`` uint8, BGR.
            box: ``(x, y, w, h)``, pixels, 0-based.

        Raises:
            UserError: the frame or the box cannot be used.
        """
        ...

    def update(self, frame: Image) -> Track:
        """Find the target in the next frame ``(H, W, 3)`` uint8, BGR; its size may differ from the first frame's.

        Raises:
            UserError: `init` was not called, or the frame cannot be used.
        """
        ...

    def close(self) -> None:
        """Release what the tracker holds, such as a worker process; may be called twice."""
        ...

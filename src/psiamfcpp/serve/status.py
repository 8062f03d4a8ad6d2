"""What clients get about a moment, as plain data."""

from __future__ import annotations

import time
from typing import Any

from psiamfcpp.serve.control import Control
from psiamfcpp.serve.follower import Shot, bearing

# A camera of ten frames a second is never silent for so long.
_SILENT_S = 2.0


def status(control: Control, client: str, fov: float | None) -> dict[str, Any]:
    """The state of everything; the API's documentation describes the fields.

    Args:
        control: what is asked.
        client: who asks.
        fov: horizontal field of view of the camera, degrees, if known.
    """
    follower = control.follower
    shot = follower.newest
    age = None if follower.read_at is None else time.perf_counter() - follower.read_at
    holder = control.lease.holder
    return {
        "frame": shot.number if shot else 0,
        "width": shot.image.shape[1] if shot else 0,
        "height": shot.image.shape[0] if shot else 0,
        "fps": round(follower.fps, 1),
        "tracker_ms": round(1000 * shot.tracker_s, 2) if shot and shot.tracks else None,
        "source": {
            "name": follower.name,
            "state": "paused" if follower.paused else "playing" if age is not None and age < _SILENT_S else "silent",
            "age_ms": round(1000 * age) if age is not None else None,
            "live": follower.live,
            "frame": None if follower.live else follower.position,
            "frames": follower.frame_count,
            "fps": round(follower.source_fps, 3),
        },
        "targets": targets(shot, fov) if shot else [],
        "selected": shot.selected if shot else None,
        "operator": "none" if holder is None else "you" if holder == client else "other",
        "asked": holder == client and control.lease.asking is not None,
        "recording": None if control.recorder is None else control.recorder.on,
    }


def targets(shot: Shot, fov: float | None) -> list[dict[str, Any]]:
    """Number, box, score, state and bearing of each target of a shot."""
    found = []
    for number, track in shot.tracks.items():
        target: dict[str, Any] = {
            "id": number,
            "box": [round(v, 2) for v in track.box],
            "score": None if track.score is None else round(track.score, 4),
            "state": track.state,
        }
        if fov is not None:
            azimuth, elevation = bearing(track, shot.image, fov)
            target["bearing"] = {"azimuth_deg": round(azimuth, 3), "elevation_deg": round(elevation, 3)}
        found.append(target)
    return found

"""`psiamfcpp serve`: what it refuses before it takes time, and a whole server's life in a process of its own."""

from __future__ import annotations

import csv
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from .conftest import Run, count_frames


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--host", "0.0.0.0"], "--host 0.0.0.0 can be reached by others: give a --token"),
        (["--host", "0.0.0.0", "--token", "short"], "the token has 5 characters"),
        (["--host", "203.0.113.7", "--token", "long enough it is"], "cannot listen on 203.0.113.7"),
        (["--port", "99999"], "cannot listen on 127.0.0.1 port 99999"),
        (["--fov", "0"], "fov is 0"),
        (["--fov", "nan"], "fov is nan"),
        (["--mavlink", "tcp:1"], "mavlink 'tcp:1' is no link"),
        (["--mavlink", "udpin:127.0.0.1:14571", "--mavlink-system", "300"], "mavlink system is 300"),
        (["--record", "/dev/null/x"], "recordings /dev/null/x cannot be written"),
        (["--model", "nothing"], "model 'nothing'"),
    ],
)
def test_wrong_options_are_refused(
    run: Run, tiny_model: Path, clip: Path, options: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PSIAMFCPP_TOKEN", raising=False)
    model = [] if "--model" in options else ["--model", tiny_model]
    port = [] if "--port" in options else ["--port", "0"]
    assert message in run("serve", clip, *port, *model, *options).refused()


def test_a_source_without_frames_is_refused(run: Run, tiny_model: Path) -> None:
    assert "missing.mp4 does not exist" in run("serve", "missing.mp4", "--port", "0", "--model", tiny_model).refused()


def test_a_port_that_is_taken_is_named(run: Run, tiny_model: Path, clip: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert f"port {port}" in run("serve", clip, "--port", port, "--model", tiny_model).refused()


@pytest.mark.slow
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_a_server_lives_records_and_ends_cleanly(tiny_model: Path, clip: Path, tmp_path: Path, end: Any) -> None:
    records = tmp_path / "records"
    command = [sys.executable, "-m", "psiamfcpp", "serve", str(clip), "--port", "0", "--model", str(tiny_model)]
    command += ["--record", str(records), "--threads", "1"]
    environment = {**os.environ, "PSIAMFCPP_TOKEN": "a token of the environment"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    try:
        assert process.stderr is not None
        line = process.stderr.readline()
        match = re.fullmatch(r"serving (http://127\.0\.0\.1:\d+)/\n", line)
        assert match, line
        with httpx.Client(base_url=match[1], timeout=300) as http:
            assert http.get("/api/state").status_code == 401
            http.headers["Authorization"] = "Bearer a token of the environment"
            with pytest.raises(InvalidStatus), connect(f"{match[1].replace('http', 'ws')}/api/live"):
                pass
            assert http.post("/api/recording").json() == {"ok": True}
            (folder,) = records.iterdir()
            # a clip of ten frames soon begins again, which lets targets go
            deadline = time.monotonic() + 300
            while len({line.split(",")[1] for line in (folder / "boxes.csv").read_text().splitlines()}) < 12:
                assert http.post("/api/targets", json={"box": [100, 80, 40, 30]}).status_code in (201, 429, 503)
                assert time.monotonic() < deadline
                time.sleep(0.1)
            assert http.get("/api/state").json()["recording"] is True
        process.send_signal(end)
        out, err = process.communicate(timeout=300)
        assert (process.returncode, out, err) == (0, "", "")
    finally:
        process.kill()
    assert sorted(path.name for path in folder.iterdir()) == ["boxes.csv", "video.mkv"]
    assert count_frames(folder / "video.mkv") > 5
    with (folder / "boxes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len({row["frame"] for row in rows}) >= 11
    assert all(float(row["w"]) > 0 and row["state"] in ("tracking", "unsure", "lost") for row in rows)

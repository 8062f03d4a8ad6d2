"""Show whether the server stays stable under clients that connect, leave, sleep and attack.

    python benchmarks/serve_soak.py --minutes 10 --model siamfcpp-alexnet

Starts `psiamfcpp serve` on a rendered clip in a process of its own that may open 1,024 files, connects and
disconnects, keeps four slow clients and one that reads all, sends what is wrong, and samples the server's memory,
threads and files: first with one client, after the connects, half-way, and last when all have left. Before that each
load of `serve_loads.py` runs for as long as `--load-seconds` says, while an operator with the token measures how long
it waits. Prints one JSON object; Linux only, since it reads /proc.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import resource
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import httpx
import tyro
from serve_loads import LOADS, measure
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from psiamfcpp.demo.clip import render
from psiamfcpp.video.writer import VideoWriter
from psiamfcpp.zoo import DEFAULT_MODEL

TOKEN = "only for this soak"
KNOWN = {"Authorization": f"Bearer {TOKEN}"}
_FILES = 1024


def main(
    minutes: float = 5.0,
    connects: int = 200,
    model: str = DEFAULT_MODEL,
    threads: int = 1,
    search_size: int | None = None,
    fps: float = 30.0,
    frames: int = 300,
    mavlink_port: int = 14580,
    load_seconds: float = 15.0,
) -> None:
    """Run the loads and print one JSON object.

    Args:
        minutes: how long to watch after the connects.
        connects: connections that are opened and closed first.
        model: name of a shipped model, or a model file.
        threads: threads of the engine.
        search_size: side of the search crop in pixels.
        fps: of the stream.
        frames: length of the clip, which is played over and over.
        mavlink_port: UDP port on loopback that is sent random bytes.
        load_seconds: how long each load lasts; 0 leaves them out.
    """
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder) / "clip.mp4"
        with VideoWriter(clip, fps, (1280, 720)) as video:
            for shot in render(0, frames):
                video.write(shot.image)
        command = [sys.executable, "-m", "psiamfcpp", "serve", str(clip), "--port", "0", "--model", model]
        command += ["--threads", str(threads), "--mavlink", f"udpin:127.0.0.1:{mavlink_port}"]
        command += [] if search_size is None else ["--search-size", str(search_size)]
        environment = {**os.environ, "PSIAMFCPP_TOKEN": TOKEN}
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as server:
            resource.prlimit(server.pid, resource.RLIMIT_NOFILE, (_FILES, _FILES))
            assert server.stderr is not None
            line = server.stderr.readline()
            match = re.search(r"http://(127\.0\.0\.1:\d+)/", line)
            if match is None:
                sys.exit(line)
            try:
                loads = under_loads(match[1], server.pid, mavlink_port, load_seconds)
                result = {"loads": loads, **soak(match[1], server.pid, minutes, connects, mavlink_port)}
            finally:
                server.terminate()
            result["exit_code"] = server.wait(30)
            result["said"] = server.stderr.read()
    print(json.dumps(result, indent=2))


def under_loads(address: str, process: int, mavlink_port: int, seconds: float) -> dict[str, Any]:
    """Measure the operator's waits and the server's resources under each load."""
    found: dict[str, Any] = {}
    for load in LOADS if seconds else ():
        samples: list[dict[str, float]] = []
        done = threading.Event()

        def watch_process(samples: list[dict[str, float]] = samples, done: threading.Event = done) -> None:
            while not done.wait(0.5):
                samples.append(sample(process))

        watcher = threading.Thread(target=watch_process)
        watcher.start()
        found[load] = measure(load, address, mavlink_port, TOKEN, seconds)
        done.set()
        watcher.join()
        found[load]["highest"] = {key: max(s[key] for s in samples) for key in samples[0]}
    return found


def soak(address: str, process: int, minutes: float, connects: int, mavlink_port: int) -> dict[str, Any]:
    """Run all clients against one server; return the measurements."""
    done = threading.Event()
    latencies: list[float] = []
    trackers: list[float] = []
    reader = threading.Thread(target=watch, args=(address, done, latencies, trackers))
    reader.start()
    time.sleep(5)
    samples = [sample(process)]
    for number in range(connects):
        touch(address, abrupt=number % 2 == 1)
    time.sleep(12)
    samples.append(sample(process))
    refusals: dict[str, int] = {}
    slow = [threading.Thread(target=dawdle, args=(address, done, refusals)) for _ in range(4)]
    for client in slow:
        client.start()
    end = time.monotonic() + 60 * minutes
    while time.monotonic() < end:
        attack(address, mavlink_port, refusals)
        time.sleep(10)
        samples.append(sample(process))
    done.set()
    for client in (*slow, reader):
        client.join()
    time.sleep(40)
    samples.append(sample(process))
    beyond = [sent - own for sent, own in zip(latencies, trackers, strict=True)]
    return {
        "connects": connects,
        "minutes": minutes,
        "boxes_received": len(latencies),
        "read_to_sent_ms_median": statistics.median(latencies),
        "tracker_ms_median": statistics.median(trackers),
        "beyond_tracker_ms_median": statistics.median(beyond),
        "refusals": refusals,
        "samples": {
            "first": samples[0],
            "connected": samples[1],
            "half": samples[len(samples) // 2],
            "last": samples[-1],
        },
        "highest": {key: max(s[key] for s in samples) for key in samples[0]},
    }


def watch(address: str, done: threading.Event, latencies: list[float], trackers: list[float]) -> None:
    """Read every image as the page does, and start a target whenever there is none."""
    with connect(f"ws://{address}/api/live?client=watcher", additional_headers=KNOWN, max_size=None) as client:
        client.send('{"type": "frame"}')
        while not done.is_set():
            message = client.recv(timeout=60)
            if isinstance(message, bytes):
                client.send('{"type": "frame"}')
                continue
            told = json.loads(message)
            if told["type"] != "state":
                continue
            if told["latency_ms"] is not None and told["targets"]:
                latencies.append(told["latency_ms"])
                trackers.append(told["tracker_ms"])
            if not told["targets"] and told["frame"] % 15 == 0:
                client.send('{"type": "start", "box": [600, 330, 60, 60]}')


def dawdle(address: str, done: threading.Event, refusals: dict[str, int]) -> None:
    """Read ten messages a second of the many more that are sent, as a slow client."""
    with connect(
        f"ws://{address}/api/live", additional_headers=KNOWN, max_size=None, max_queue=1, ping_interval=None
    ) as client:
        client.send('{"type": "frame"}')
        while not done.wait(0.1):
            try:
                message = client.recv(timeout=60)
            except (ConnectionClosed, TimeoutError):
                refusals["slow client lost"] = refusals.get("slow client lost", 0) + 1
                return
            if isinstance(message, bytes):
                client.send('{"type": "frame"}')


def touch(address: str, abrupt: bool) -> None:
    """Connect, read an image and leave, with a close message or without."""
    client = connect(f"ws://{address}/api/live", additional_headers=KNOWN).__enter__()
    client.send('{"type": "frame"}')
    client.recv(timeout=60)
    if abrupt:
        # not `close`: the client's thread would go on reading from whatever has the number of the file next
        client.socket.shutdown(socket.SHUT_RDWR)
    else:
        client.close()


def attack(address: str, mavlink_port: int, refusals: dict[str, int]) -> None:
    """Send what must be refused, and count the refusals."""

    def count(what: object) -> None:
        refusals[str(what)] = refusals.get(str(what), 0) + 1

    with httpx.Client(base_url=f"http://{address}", headers=KNOWN, timeout=60) as http:
        for body in (b'{"box": [NaN, 0, 1, 1]}', b'{"box": [9e4, 0, 5, 5]}', b"{", b"x" * 100_000):
            count(http.post("/api/targets", content=body, headers={"Content-Type": "application/json"}).status_code)
        count(http.delete("/api/targets", headers={"Origin": "http://elsewhere"}).status_code)
        count(http.delete("/api/targets", headers={"X-Client": "other"}).status_code)
    try:
        with connect(f"ws://{address}/api/live", origin="http://elsewhere"):  # type: ignore[arg-type]
            count("foreign origin let in")
    except InvalidStatus as refusal:
        count(refusal.response.status_code)
    for text in ("x" * 50_000, '{"type": "start", "box": [1, 1, 50, 50]}'):
        try:
            with connect(f"ws://{address}/api/live", additional_headers=KNOWN, max_size=None) as client:
                for _ in range(1000):
                    client.send(text)
                # a server that is slow enough keeps up with the flood, and need not close
                end = time.monotonic() + 10
                while time.monotonic() < end:
                    client.recv(timeout=5)
                count("socket kept")
        except (ConnectionClosed, TimeoutError) as gone:
            closing = getattr(gone, "rcvd", None)
            count(f"socket closed with {closing.code}" if closing else "socket ignored")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        for _ in range(2000):
            station.sendto(bytes([0xFD]) + random.randbytes(random.randrange(300)), ("127.0.0.1", mavlink_port))


def sample(process: int) -> dict[str, float]:
    """Return resident memory in MiB, threads, open files and sockets of a process."""
    status = Path(f"/proc/{process}/status").read_text()
    links = []
    for link in Path(f"/proc/{process}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile
            links.append(link.readlink().name)
    return {
        "memory_mib": round(int(re.search(r"VmRSS:\s+(\d+)", status)[1]) / 1024, 1),  # type: ignore[index]
        "threads": int(re.search(r"Threads:\s+(\d+)", status)[1]),  # type: ignore[index]
        "files": len(links),
        "sockets": sum("socket" in link for link in links),
    }


if __name__ == "__main__":
    tyro.cli(main)

"""Drive a TraX server with the client of `vot-trax`, and print what it answers as JSON.

Usage: reference_client.py KIND FILE... -- COMMAND..., with KIND path, memory, buffer or url. The files are frames; of
the first the target is at 10,20,30,40. Then a second target, at 5,6,7,8, is followed through the same frames.

A process of its own: the library ends its host when something goes wrong.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import trax
import trax.client
import trax.image
import trax.region

BOXES = ((10, 20, 30, 40), (5, 6, 7, 8))


def image(kind: str, path: str) -> Any:
    if kind == "path":
        return trax.image.FileImage.create(path)
    if kind == "url":
        return trax.image.URLImage.create(Path(path).as_uri())
    if kind == "buffer":
        return trax.image.BufferImage.create(Path(path).read_bytes())
    return trax.image.MemoryImage.create(cv2.cvtColor(cv2.imread(path), cv2.COLOR_BGR2RGB))


def main() -> None:
    kind, *rest = sys.argv[1:]
    end = rest.index("--")
    files, command = rest[:end], rest[end + 1 :]
    server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert server.stdin is not None and server.stdout is not None
    streams = (server.stdin.fileno(), server.stdout.fileno())
    client = trax.client.Client(stream=streams, timeout=300, log="/dev/null")
    found: dict[str, Any] = {"name": client.tracker_name, "images": client.image_formats, "targets": []}
    for box in BOXES:
        region = trax.region.Rectangle.create(*box)
        replies = [client.initialize({"color": image(kind, files[0])}, [(region, {})], {})]
        replies += [client.frame({"color": image(kind, file)}, {}, []) for file in files[1:]]
        states = [objects[0] for objects, _ in replies]
        found["targets"].append([[list(region.bounds()), properties] for region, properties in states])
    client.quit()
    found["status"] = server.wait(300)
    print(json.dumps(found))


main()

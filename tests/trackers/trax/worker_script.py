"""A TraX worker for tests, written in raw messages: well-behaved by default, and hostile in many ways.

Usage: worker_script.py MODE [VERSION] [IMAGES]. Its box moves by one pixel per frame.
"""

import base64
import os
import signal
import sys
import time

MODE = sys.argv[1] if len(sys.argv) > 1 else "good"
VERSION = sys.argv[2] if len(sys.argv) > 2 else "4"
IMAGES = sys.argv[3] if len(sys.argv) > 3 else "memory;"


def say(text):
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def fork_away(setsid):
    """Leave a descendant behind that holds our streams and never ends."""
    if os.fork() == 0:
        if setsid:
            os.setsid()
        if os.fork() == 0:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            time.sleep(3600)
        os._exit(0)


def hello():
    if MODE == "silent":
        time.sleep(3600)
    if MODE == "dies-at-start":
        print("ImportError: no module named tracker", file=sys.stderr)
        sys.exit(3)
    if MODE == "not-trax":
        say("Usage: this is no TraX tracker")
        sys.exit(0)
    if MODE == "prints-first":
        say("Loading the model ...")
        sys.stdout.write("50 %")
    version = "abc" if MODE == "version" else VERSION
    channels = "color;depth;" if MODE == "channels" else "color;"
    regions = {"polygon": "polygon;", "mask": "mask;", "regions": "ellipse;"}.get(MODE, "rectangle;")
    say(f'@@TRAX:hello "trax.version={version}" trax.image={IMAGES} trax.region={regions} "trax.channels={channels}"')


def answer(count, region):
    x, y, w, h = region
    state = f"@@TRAX:state {x + count},{y},{w},{h}"
    if count == 1 and MODE == "hangs":
        # before an answer, so that it has arrived when the next one is given up
        print("still thinking", file=sys.stderr, flush=True)
    if count == 1 and MODE == "endless-lines":
        say("chatter\nchatter")
    if count < 2:
        return say(state)
    if MODE == "dies":
        print("first line\nMemoryError: not enough", file=sys.stderr)
        sys.exit(7)
    if MODE == "killed":
        os.kill(os.getpid(), signal.SIGSEGV)
    if MODE == "hangs":
        time.sleep(3600)
    if MODE == "hangs-deaf":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        while True:
            time.sleep(3600)
    if MODE == "closes-output":
        os.close(1)
        time.sleep(3600)
    if MODE == "forks":
        fork_away(setsid=True)
        sys.exit(5)
    if MODE == "forks-and-goes-on":
        fork_away(setsid=True)
    if MODE == "huge-line":
        while True:
            sys.stdout.write("x" * 100000)
    if MODE == "endless-lines":
        while True:
            sys.stdout.write("chatter\n" * 10000)
    if MODE == "quits":
        return say('@@TRAX:quit "trax.reason=target \\"gone\\""')
    if MODE == "prints":
        say("frame done")
    answers = {
        "garbage": "@@TRAX:state what,is,this,now",
        "nan": "@@TRAX:state 1,2,nan,4",
        "negative": "@@TRAX:state 1,2,-3,4",
        "three": "@@TRAX:state 1,2,3",
        "no-region": "@@TRAX:state",
        "two-regions": "@@TRAX:state 1,2,3,4 5,6,7,8",
        "two-states": state + "\n" + state,
        "hello-again": "@@TRAX:hello",
        "no-name": "@@TRAX: 1,2,3,4",
        "lost": "@@TRAX:state 0",
        "properties": state + ' confidence=0.25 "state=unsure" "other=a b"',
        "bad-properties": state + " confidence=high state=asleep",
        "polygon-answer": "@@TRAX:state 10,20,30,20,30,50,10,50.5",
        "mask-answer": "@@TRAX:state mask:5,6,4,3,5,2,2,2,1",
    }
    say(answers.get(MODE, state))


def pixel(image):
    """First pixel of an image in any form, as R,G,B, printed for the test."""
    if image.startswith("image:"):
        return tuple(base64.b64decode(image.split(";", 3)[3])[:3])
    import cv2
    import numpy as np

    if image.startswith("data:"):
        array = cv2.imdecode(np.frombuffer(base64.b64decode(image.rpartition(";")[2]), np.uint8), 1)
    else:
        array = cv2.imread(image[len("file://") :])
    return tuple(int(v) for v in array[0, 0, ::-1])


def region_of(text):
    values = text[5:].split(",")[:4] if text.startswith("mask:") else text.split(",")
    values = [float(v) for v in values]
    if len(values) == 8:
        return [values[0], values[1], values[4] - values[0], values[5] - values[1]]
    return values


def main():
    hello()
    region, count, begun = None, 0, False
    if MODE == "deaf":
        time.sleep(3600)
    for line in sys.stdin:
        words = line.replace('"', "").strip().split(" ")
        kind, arguments = words[0], words[1:]
        if kind == "@@TRAX:quit":
            return
        if kind == "@@TRAX:initialize":
            if begun and MODE == "one-target":
                return say("@@TRAX:quit")
            region = region_of(arguments[-1]) if arguments else None
            count = -1
            if len(arguments) < 2:
                continue
        count += 1
        begun = True
        if MODE == "pixel":
            say("@@TRAX:state {},{},{},1".format(*pixel(arguments[0])))
        else:
            answer(count, region)


main()

"""Show whether memory stays flat on a long stream: follow a rendered vehicle for 20,000 frames.

    python benchmarks/memory.py [MODEL] [--frames 20000] [--threads N]

Prints the resident memory every tenth of the way, the peak, and by how much the last tenth is above the second. Reads
/proc, so Linux only.
"""

import argparse
import itertools
import resource
from pathlib import Path

from psiamfcpp import Tracker
from psiamfcpp.demo.clip import render
from psiamfcpp.zoo import DEFAULT_MODEL


def resident() -> float:
    """Return the resident memory of this process in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", nargs="?", default=DEFAULT_MODEL)
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--threads", type=int)
    options = parser.parse_args()
    shots = list(render(0, 30))
    before = resident()
    # the peak of rendering is not the tracker's, so the kernel's mark is reset
    Path("/proc/self/clear_refs").write_text("5")
    tracker = Tracker(options.model, threads=options.threads)
    tracker.init(shots[0].image, shots[0].box)
    # forwards and backwards, so that the target never jumps
    there_and_back = itertools.cycle([*shots, *shots[::-1]])
    seen = []
    for number, shot in enumerate(itertools.islice(there_and_back, options.frames), start=1):
        tracker.update(shot.image)
        if number % (options.frames // 10) == 0:
            seen.append(resident())
            print(f"{number:6} frames  {seen[-1]:.1f} MB", flush=True)
    status = Path("/proc/self/status").read_text()
    peak = int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) * 1024 / 1e6
    frames = sum(shot.image.nbytes for shot in shots) / 1e6
    print(f"peak {peak:.0f} MB; before a model was loaded {before:.0f} MB, with the {frames:.0f} MB of the clip")
    print(f"growth from the second to the last tenth: {seen[-1] - seen[1]:+.1f} MB")


if __name__ == "__main__":
    main()

"""`examples/minimal.py` follows a target without the package, and as the package does."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from psiamfcpp import Tracker
from psiamfcpp.demo.clip import DemoFrame, render
from psiamfcpp.geometry import Image
from psiamfcpp.video.source import open_source
from psiamfcpp.video.writer import VideoWriter
from psiamfcpp.zoo import graph_folder

SCRIPT = Path(__file__).parents[2] / "examples" / "minimal.py"
# As if the package, and all that it does not need, were not installed.
WITHOUT = "sys.modules.update(dict.fromkeys(('psiamfcpp', 'torch', 'onnx', 'rich', 'tyro')))"


@pytest.fixture
def ride(tmp_path: Path, rendered_clip: list[DemoFrame]) -> Iterator[tuple[Path, tuple[float, ...], list[Image]]]:
    path = tmp_path / "ride.mp4"
    shots = rendered_clip[:12]
    with VideoWriter(path, 25, (320, 192)) as writer:
        for shot in shots:
            writer.write(shot.image)
    with open_source(str(path)) as source:
        yield path, shots[0].box, list(source)


@pytest.mark.slow
def test_it_gives_the_boxes_of_the_package(
    tiny_graphs: Path, ride: tuple[Path, tuple[float, ...], list[Image]]
) -> None:
    path, box, frames = ride
    tracker = Tracker(str(tiny_graphs), threads=1, plain=True)
    tracker.init(frames[0], box)
    expected = np.array([tracker.update(frame).box for frame in frames[1:]])
    code = f"import sys, runpy; {WITHOUT}; sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
    text_box = ",".join(repr(float(v)) for v in box)
    done = subprocess.run(
        [sys.executable, "-c", code, str(SCRIPT), str(tiny_graphs), str(path), text_box],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    found = np.array([[float(v) for v in line.split(",")] for line in done.stdout.splitlines()])
    assert found.shape == (11, 4)
    assert_allclose(found, expected, atol=0.02)


@pytest.mark.slow
def test_the_boxes_are_equal_where_they_depend_on_single_roundings() -> None:
    # 8-bit graphs on a piece of bare ground: a difference in the last digit soon is a difference of pixels.
    sys.path.insert(0, str(SCRIPT.parent))
    try:
        from minimal import Minimal  # type: ignore[import-not-found]
    finally:
        sys.path.pop(0)
    name = "psiamfcpp-alexnet-s-int8"
    minimal, tracker = Minimal(str(graph_folder(name)), threads=1), Tracker(name, threads=1, plain=True)
    box = (120.0, 90.0, 60.0, 50.0)
    first, *shots = (shot.image for shot in render(4, 40, (320, 192)))
    minimal.init(first, box)
    tracker.init(first, box)
    for image in shots:
        assert minimal.update(image) == pytest.approx(tracker.update(image).box, abs=1e-6)


def test_it_is_short() -> None:
    assert len(SCRIPT.read_text().splitlines()) <= 80

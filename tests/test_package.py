"""The package as those who install it meet it: what importing it costs, and what its types say."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import pytest

import psiamfcpp

SOURCE = str(Path(psiamfcpp.__file__).parents[1])

# Each line marked "wrong" must be refused: where a type is lost, it is Any, nothing is refused, and mypy calls the
# mark unused.
SCRIPT = """
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from psiamfcpp import (
    RunOptions, Span, TargetPool, Timing, Track, Tracker, TrackerOptions, TrackingConstants, TrainOptions, UserError,
    __version__, bench, calibrate, evaluate, export_graphs, follow, import_model, info, list_trackers, open_tracker,
    plan, prune, rank, reproduce, score, sensitivity, train, write_report,
)

version: str = __version__
frame: NDArray[np.uint8] = np.zeros((240, 320, 3), np.uint8)
options = TrackerOptions(threads=1, plain=True)
TrackerOptions(threads="one")  # type: ignore[arg-type]  # wrong
tracker = Tracker(options=options)
first: Track = tracker.init(frame, (100, 80, 40, 30))
x, y, w, h = tracker.update(frame).box
width: float = w
tracker.update("frame")  # type: ignore[arg-type]  # wrong
state: str = first.state  # type: ignore[assignment]  # wrong: it may be None
pool = TargetPool(options=options)
number, track = pool.add(frame, (100, 80, 40, 30))
value: float | None = pool.update(frame)[number].score
pool.add(frame, (100, 80, 40, 30)).box  # type: ignore[attr-defined]  # wrong
other = open_tracker("dcf:kcf", options)
other.init(frame, (100, 80, 40, 30))
other.close("now")  # type: ignore[call-arg]  # wrong
span = Span(start="1:30", every=2)
shots: Iterator[list[Track]] = follow("flight.mp4", [(618, 329, 53, 46)], options=options, span=span)
def everything_else() -> None:
    trained = train(["clips:CLIPS"], "start.safetensors", "run", options=TrainOptions(seed=1), run=RunOptions())
    table = rank(trained, ["clips:CLIPS"], images=4)
    plan(table, remove="0.3")  # type: ignore[arg-type]  # wrong
    planned = plan("ranks.json", target_latency=2.5, timing=Timing(threads=1))
    macs: float = plan(table, target_macs=0.5).after["gmacs"]
    pruned = prune("siamfcpp-alexnet", planned.plan, "pruned.safetensors")
    rates = calibrate("pruned.safetensors", "CLIPS", constants=TrackingConstants()).rates.hit
    export_graphs("pruned.safetensors", "graphs", int8="yes")  # type: ignore[arg-type]  # wrong
    print(info("opencv:mil")["kind"], list_trackers()[0].name, import_model(["official.pkl"]).spec, rates)
    measured = [*evaluate("SEQUENCES", results="results"), *score("dtb70", "LABELS", ["TRACKERS"])]
    precision: float = measured[0].mean["otb"].figures["precision"]
    cells = sensitivity("siamfcpp-alexnet", "ranks.json", "SEQUENCES", "out", shares=[0.5])
    pages = [*write_report(["results"], "report"), *reproduce(dry_run=True).files]
    fps: float = bench(threads=1).processors[0]["fps_cpu"]
try:
    boxes = [[track.box for track in tracks] for tracks in shots]
except UserError as error:
    print(error)
"""


def test_the_package_says_that_it_is_typed():
    assert (files("psiamfcpp") / "py.typed").is_file(), "without it mypy takes every type of the package for Any"


def test_importing_the_package_imports_nothing_heavy():
    heavy = ("torch", "matplotlib", "scipy", "onnxruntime", "numba", "av", "tyro")
    code = f"import sys, psiamfcpp; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": SOURCE}, capture_output=True, text=True
    )
    assert (done.stdout, done.stderr) == ("[]\n", "")


def test_the_users_script_names_every_export():
    assert set(psiamfcpp.__all__) <= set(re.findall(r"\w+", SCRIPT))


@pytest.mark.slow
def test_a_users_script_passes_the_strict_type_check(tmp_path: Path):
    (tmp_path / "script.py").write_text(SCRIPT)
    # an empty file of settings, so that none of the machine's are taken
    (tmp_path / "mypy.ini").write_text("[mypy]\n")
    # kept from run to run, as it takes half a minute to make
    cache = Path(__file__).parents[1] / ".mypy_cache" / "users_script"
    command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", f"--cache-dir={cache}", "script.py"]
    environment = {**os.environ, "MYPYPATH": SOURCE}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout


def test_every_public_name_is_there_and_no_other() -> None:
    assert {name for name in psiamfcpp.__all__ if getattr(psiamfcpp, name) is not None} == set(psiamfcpp.__all__)
    assert set(psiamfcpp.__all__) <= set(dir(psiamfcpp))
    with pytest.raises(AttributeError, match="has no attribute 'Trakcer'"):
        _ = psiamfcpp.Trakcer  # type: ignore[attr-defined]


@pytest.mark.slow
def test_no_telemetry(tmp_path: Path) -> None:
    # onnxruntime would write an identifier to the home folder; on machines of CI it writes none.
    kept = {name: value for name, value in os.environ.items() if name not in ("CI", "ORT_DISABLE_TELEMETRY")}
    home = {**kept, "HOME": str(tmp_path), "PYTHONPATH": SOURCE}
    code = "import psiamfcpp; psiamfcpp.Tracker('psiamfcpp-alexnet-n-int8')"
    subprocess.run([sys.executable, "-c", code], env=home, check=True)
    assert not list(tmp_path.rglob("*onnxruntime*"))

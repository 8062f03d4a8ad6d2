"""Runs that are cut short, go on, or are carried out by others."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from joblib.externals.loky import get_reusable_executor

from psiamfcpp import datasets
from psiamfcpp.cli import main
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.running import RUN_FILE, read_run, run
from psiamfcpp.trackers import TrackerOptions, choose
from psiamfcpp.watch import Watch

BOXES = [(100.0 + 3 * t, 80.0 + t, 40.0, 30.0) for t in range(4)]
NAMES = ("car1", "car2", "car3", "car4")

# Stands still; leaves a line for each target that it takes up, and never ends with the one at which it is to stop.
MODULE = """
import os, pathlib, time
class Slow:
    def init(self, image, box):
        with open(os.environ["INITS"], "a") as file:
            file.write("init\\n")
        self.box = box
    def update(self, image):
        if len(open(os.environ["INITS"]).readlines()) >= float(os.environ.get("STOP_AT", "inf")):
            time.sleep(3600)
        return self.box
class Other(Slow):
    pass
class Known(Slow):
    def init(self, image, box):
        pathlib.Path(f"pid{os.getpid()}").touch()
        super().init(image, box)
class Wordy(Slow):
    def update(self, image):
        raise ValueError("no\\nway")
class Deadly(Slow):
    def update(self, image):
        os.kill(os.getpid(), 9)
"""


@pytest.fixture
def root(blob_sequence: Callable[..., Path]) -> Path:
    """Four sequences."""
    roots = {blob_sequence(name, BOXES) for name in NAMES}
    return roots.pop()


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module of trackers in the working directory, also for other processes."""
    name = f"slow_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("INITS", str(tmp_path / "inits"))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    # joblib keeps its workers, with the environment that they were started in
    get_reusable_executor().shutdown(wait=True)
    return name


def inits() -> int:
    """How many targets were taken up since the last time this was asked."""
    path = Path(os.environ["INITS"])
    count = _lines(path)
    path.unlink(missing_ok=True)
    return count


def _lines(path: Path) -> int:
    return len(path.read_text().splitlines()) if path.exists() else 0


def results(folder: Path) -> dict[str, str]:
    """Result files by sequence; nothing but whole ones may be there."""
    found = {path.stem: path.read_text() for path in folder.glob("*.txt") if not path.stem.endswith("_time")}
    assert all(text.count("\n") == len(BOXES) for text in found.values())
    return found


@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_was(root: Path, module: str, tmp_path: Path) -> None:
    folder = tmp_path / "r" / "folder" / "Slow"
    command = ["evaluate", "--root", str(root), "--tracker", f"{module}:Slow", "--results", str(tmp_path / "r")]
    process = subprocess.Popen([sys.executable, "-m", "psiamfcpp", *command], env={**os.environ, "STOP_AT": "3"})
    deadline = time.monotonic() + 300
    # at the third sequence it stands still, until it is killed
    while _lines(tmp_path / "inits") < 3 and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    done = results(folder)
    assert done.keys() == {"car1", "car2"}
    inits()
    assert main([*command, "--json"]) == 0
    assert inits() == len(NAMES) - len(done)
    assert results(folder).keys() == {*NAMES}


@pytest.mark.slow
def test_a_killed_run_leaves_no_worker_behind(root: Path, module: str, tmp_path: Path) -> None:
    command = ["evaluate", "--root", str(root), "--tracker", f"{module}:Known", "--results", str(tmp_path / "r")]
    process = subprocess.Popen(
        [sys.executable, "-m", "psiamfcpp", *command, "--jobs", "2"], env={**os.environ, "STOP_AT": "1"}
    )
    deadline = time.monotonic() + 300
    while len(workers := [*tmp_path.glob("pid*")]) < 2 and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.01)
    process.kill()
    process.wait()
    left = {int(path.name.removeprefix("pid")) for path in workers}
    assert len(left) == 2
    deadline = time.monotonic() + 300
    while left and time.monotonic() < deadline:
        time.sleep(0.05)
        left = {pid for pid in left if _runs(pid)}
    assert not left


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        # where nobody buries the dead they keep their number
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except (ProcessLookupError, FileNotFoundError):
        return False


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_text(path.read_text()[:-9]),
        lambda path: path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1])),
        lambda path: path.write_text(path.read_text() * 2),
        lambda path: path.write_bytes(b""),
        lambda path: path.with_name("car2_time.txt").unlink(),
        lambda path: path.with_name("car2_time.txt").write_text("0.1,0.1\n"),
        # a start from another box: the labels were mended since
        lambda path: path.write_text("1,2,3,4\n" * len(BOXES)),
    ],
    ids=["cut in a line", "short", "long", "empty", "no times", "short times", "other label"],
)
def test_what_is_not_whole_is_done_again(
    root: Path, module: str, tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    sequences, choices = datasets.read("folder", root), [choose(f"{module}:Slow")]
    run(choices, "folder", root, sequences, tmp_path / "r")
    whole = results(tmp_path / "r" / "folder" / "Slow")
    inits()
    damage(tmp_path / "r" / "folder" / "Slow" / "car2.txt")
    told: list[int | None] = []

    def track(items, description, total=None):  # type: ignore[no-untyped-def]
        told.append(total)
        return items

    assert run(choices, "folder", root, sequences, tmp_path / "r", watch=Watch(track=track)) == []
    assert inits() == 1
    assert told == [1]
    assert results(tmp_path / "r" / "folder" / "Slow") == whole


@pytest.mark.slow
def test_several_trackers_side_by_side_leave_the_same_as_one_by_one(root: Path, module: str, tmp_path: Path) -> None:
    sequences = datasets.read("folder", root)
    (root / "car3" / "img" / "0002.png").write_bytes(b"no image")
    choices = [choose(f"{module}:Slow"), choose(f"{module}:Other")]
    problems = run(choices, "folder", root, sequences, tmp_path / "a")
    assert sorted(run(choices, "folder", root, sequences, tmp_path / "b", jobs=2)) == sorted(problems)
    assert [problem.split(": image")[0] for problem in problems] == ["Slow on sequence car3", "Other on sequence car3"]
    for name in ("Slow", "Other"):
        one, two = (results(tmp_path / place / "folder" / name) for place in "ab")
        assert one == two
        assert one.keys() == {"car1", "car2", "car4"}
    facts = read_run(tmp_path / "b" / "folder" / "Slow")
    assert facts is not None
    assert (facts["jobs"], facts["threads"], facts["root"]) == (2, None, str(root))


@pytest.mark.slow
def test_a_worker_that_is_killed_is_said(root: Path, module: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"a process that ran sequences was killed, .*give fewer --jobs"):
        run([choose(f"{module}:Deadly")], "folder", root, datasets.read("folder", root), tmp_path / "r", jobs=2)
    assert results(tmp_path / "r" / "folder" / "Deadly") == {}


@pytest.mark.slow
def test_a_dask_cluster_of_two_workers(root: Path, module: str, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="dask[distributed] is not installed")
    import dask

    sequences, choices = datasets.read("folder", root), [choose(f"{module}:Slow"), choose(f"{module}:Other")]
    run(choices, "folder", root, sequences, tmp_path / "here")
    inits()
    # a slow machine may take longer to start its processes than Dask waits by default
    patient = {
        "distributed.comm.timeouts.connect": "600s",
        "distributed.comm.timeouts.tcp": "600s",
        "distributed.scheduler.worker-ttl": None,
    }
    with (
        dask.config.set(patient),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
    ):
        address = cluster.scheduler_address
        assert run(choices, "folder", root, sequences, tmp_path / "there", cluster=address) == []
        assert inits() == 2 * len(NAMES)
        assert run(choices, "folder", root, sequences, tmp_path / "there", cluster=address) == []
        assert inits() == 0
    for name in ("Slow", "Other"):
        here, there = (results(tmp_path / place / "folder" / name) for place in ("here", "there"))
        assert here == there
        assert there.keys() == {*NAMES}


@pytest.mark.slow
def test_a_cluster_that_does_not_answer(root: Path, module: str, tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="dask[distributed] is not installed")
    sequences, choices = datasets.read("folder", root), [choose(f"{module}:Slow")]
    for address in ("nonsense", "nothing://here:1", "ray://here:1"):
        with pytest.raises(UserError, match=f"no Dask scheduler answers at {address}"):
            run(choices, "folder", root, sequences, tmp_path / "r", cluster=address)


def test_a_folder_keeps_to_one_tracker(root: Path, tiny_model: Path, tmp_path: Path) -> None:
    sequences = datasets.read("folder", root)[:1]
    small = TrackerOptions(search_size=239)
    run([choose(str(tiny_model))], "folder", root, sequences, tmp_path / "r")
    with pytest.raises(UserError, match=r"tiny was made with search_size None and not 239: give another folder"):
        run([choose(str(tiny_model), small)], "folder", root, sequences, tmp_path / "r")
    (tmp_path / "r" / "folder" / "tiny" / RUN_FILE).unlink()
    with pytest.raises(UserError, match="tiny holds results of another origin"):
        run([choose(str(tiny_model))], "folder", root, sequences, tmp_path / "r")
    with pytest.raises(UserError, match="two trackers are called tiny"):
        run([choose(str(tiny_model)), choose(str(tiny_model), small)], "folder", root, sequences, tmp_path / "r")
    with pytest.raises(UserError, match="two sequences are called car1"):
        run([choose(str(tiny_model))], "folder", root, sequences * 2, tmp_path / "r")


@pytest.mark.slow
def test_threads_are_stated_only_if_they_were_the_same(
    root: Path, tiny_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stated(threads: int | None, sequences: int) -> int | None:
        choice = choose(str(tiny_model), TrackerOptions(threads=threads))
        run([choice], "folder", root, datasets.read("folder", root)[:sequences], tmp_path / "r")
        facts = read_run(tmp_path / "r" / "folder" / "tiny")
        assert facts is not None
        return facts["threads"]

    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert stated(None, sequences=1) == 1
    assert stated(2, sequences=1) == 1  # nothing was left to run with two
    assert stated(1, sequences=2) == 1
    assert stated(2, sequences=3) is None


def test_a_tracker_that_cannot_be_opened_leaves_nothing_behind(root: Path, module: str, tmp_path: Path) -> None:
    choices = [choose(f"{module}:Slow"), choose(f"{module}:Missing")]
    with pytest.raises(UserError, match="cannot be opened"):
        run(choices, "folder", root, datasets.read("folder", root), tmp_path / "r")
    assert not (tmp_path / "r").exists()


def test_what_went_wrong_is_one_line_a_sequence(root: Path, module: str, tmp_path: Path) -> None:
    sequences = datasets.read("folder", root)
    problems = run([choose(f"{module}:Wordy")], "folder", root, sequences, tmp_path / "r")
    assert len(problems) == len(NAMES)
    for name, problem in zip(NAMES, problems, strict=True):
        assert problem.startswith(f"Wordy on sequence {name}: ")
        assert "ValueError: no way" in problem
    assert results(tmp_path / "r" / "folder" / "Wordy") == {}


@pytest.mark.parametrize("text", ["", "{}", "[]", json.dumps({"format": "psiamfcpp-run/9"})])
def test_a_damaged_run_file_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / RUN_FILE).write_text(text)
    with pytest.raises(UserError, match=r"run\.json is (damaged|not JSON).*remove its folder"):
        read_run(tmp_path)
    assert read_run(tmp_path / "elsewhere") is None

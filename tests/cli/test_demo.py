"""`psiamfcpp demo`, on clips of a few frames."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from psiamfcpp.cli.output import parse_box
from psiamfcpp.demo.clip import DemoFrame, render
from psiamfcpp.video.source import open_source

from .conftest import Run, count_frames


@pytest.fixture
def small(rendered_clip: list[DemoFrame], monkeypatch: pytest.MonkeyPatch) -> None:
    """The clip that is there already, in place of one that is rendered anew."""

    def shown(seed: int, frames: int) -> Iterator[DemoFrame]:
        render(seed, frames)  # which refuses numbers at once, and renders later
        return iter(rendered_clip[:frames])

    monkeypatch.setattr("psiamfcpp.cli.demo.render", shown)


@pytest.mark.slow
def test_demo_writes_a_video_and_says_how_well_it_went(run: Run, tmp_path: Path, tiny_model: Path) -> None:
    output = tmp_path / "demo.mp4"
    ended = run("demo", "--model", tiny_model, "--frames", 4, "--output", output, "--json")
    assert (ended.code, ended.err) == (0, "")
    result = json.loads(ended.out)
    assert result.keys() == {
        *("frames", "fps", "precision", "normalized_precision", "auc", "success50"),
        *("hidden_frames", "hidden_not_tracking", "output", "clip", "box"),
    }
    assert (result["frames"], result["output"]) == (4, str(output))
    assert 0 <= result["auc"] <= 20 / 21
    assert result["fps"] > 0
    assert count_frames(output) == count_frames(tmp_path / "demo-clip.mp4") == 4
    assert sorted(p.name for p in tmp_path.iterdir()) == ["demo-clip.mp4", "demo.mp4"]


@pytest.mark.slow
def test_demo_writes_to_the_working_folder_by_default(
    run: Run, tmp_path: Path, tiny_model: Path, small: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = run("demo", "--model", tiny_model, "--frames", 2)
    assert ended.code == 0
    assert "precision" in ended.out
    assert "video in demo.mp4" in ended.out
    assert count_frames(tmp_path / "demo.mp4") == 2


@pytest.mark.slow
def test_the_printed_command_follows_the_clean_clip(
    run: Run,
    tmp_path: Path,
    tiny_model: Path,
    small: None,
    rendered_clip: list[DemoFrame],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    printed = run("demo", "--model", tiny_model, "--frames", 3, "--output", "my demo.mp4").out
    program, *words = shlex.split(printed.splitlines()[-1])
    assert (program, words[:2]) == ("psiamfcpp", ["track", "my demo-clip.mp4"])
    assert parse_box(words[words.index("--box") + 1]) == pytest.approx(rendered_clip[0].box, abs=0.5)

    def off(video: str) -> float:
        with open_source(video) as frames:
            return float(np.abs(next(iter(frames)).astype(float) - rendered_clip[0].image).mean())

    # both are compressed, but on one nothing is drawn
    assert off("my demo-clip.mp4") < off("my demo.mp4")
    assert run(*words, "--model", tiny_model).code == 0
    assert count_frames(tmp_path / "followed.mp4") == 3


def test_an_existing_clean_clip_is_kept(run: Run, tmp_path: Path, tiny_model: Path, small: None) -> None:
    kept = tmp_path / "mine-clip.mp4"
    kept.write_text("a video of mine")
    refused = run("demo", "--model", tiny_model, "--frames", 2, "--output", tmp_path / "mine.mp4").refused()
    assert refused == f"output {kept} exists already: choose another name, or give --overwrite"
    assert kept.read_text() == "a video of mine"


@pytest.mark.slow
def test_of_a_tracker_without_states_none_is_counted(
    run: Run, tmp_path: Path, rendered_clip: list[DemoFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown, hidden = rendered_clip[:2]
    clip = [shown, shown, DemoFrame(hidden.image, hidden.box, False)]
    monkeypatch.setattr("psiamfcpp.cli.demo.render", lambda seed, frames: iter(clip))
    command = ("demo", "-o", tmp_path / "o.mp4", "--tracker", "opencv:mil", "--frames", 3, "--overwrite")
    result = json.loads(run(*command, "--json").out)
    assert (result["hidden_frames"], result["hidden_not_tracking"]) == (1, None)
    assert "hidden for 1 frames; this tracker states no confidence" in run(*command).out


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--frames", "1"], "frames is 1: a clip needs at least 2"),
        (["--frames", "-5"], "frames is -5"),
        (["--seed", "-1"], "seed -1"),
        (["--threads", "0"], "threads is 0"),
        (["--engine", "steam"], "unknown engine 'steam'"),
        (["--output", "demo.gif"], "demo.gif has an unknown format"),
        (["--output", "missing/demo.mp4"], "missing/demo.mp4 cannot be written"),
    ],
)
@pytest.mark.usefixtures("small")
def test_demo_refuses(
    run: Run, tmp_path: Path, tiny_model: Path, args: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in run("demo", "--model", tiny_model, *args).refused()
    assert list(tmp_path.iterdir()) == []


def test_demo_interrupted_leaves_a_valid_video(
    run: Run, tmp_path: Path, tiny_model: Path, small: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    from psiamfcpp import TargetPool

    update = TargetPool.update
    calls = iter(range(100))

    def until(self: TargetPool, frame: object) -> object:
        if next(calls) == 2:
            raise KeyboardInterrupt
        return update(self, frame)  # type: ignore[arg-type]

    monkeypatch.setattr(TargetPool, "update", until)
    ended = run("demo", "--model", tiny_model, "--frames", 6, "--output", tmp_path / "demo.mp4", "--json")
    assert (ended.code, ended.out, ended.complaint()) == (130, "", "interrupted")
    assert count_frames(tmp_path / "demo.mp4") == count_frames(tmp_path / "demo-clip.mp4") == 3
    assert sorted(p.name for p in tmp_path.iterdir()) == ["demo-clip.mp4", "demo.mp4"]

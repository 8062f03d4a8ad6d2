"""Classes of others: what they are given, and what is said where they fail."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.trackers import choose

FRAME = np.zeros((48, 64, 3), np.uint8)
FRAME[..., 0] = 200  # blue
BOX = np.array([10.0, 12.0, 20.0, 16.0])

MODULE = """
import numpy as np
class Standing:
    def init(self, image, box):
        self.image, self.box = image, box
    def update(self, image):
        return self.box
class Bgr(Standing):
    image_format = "bgr"
class Pil(Standing):
    image_format = "pil"
class Grey(Standing):
    image_format = "grey"
class Keyed(Standing):
    def __init__(self, **keys):
        self.keys = keys
class NoUpdate:
    def init(self, image, box): pass
class NeedsAnArgument:
    def __init__(self, weights): pass
class Fails(Standing):
    def update(self, image):
        raise ValueError("no such thing")
class Nothing(Standing):
    def update(self, image):
        return None
class Talks(Standing):
    def __init__(self):
        print("loading")
    def update(self, image):
        print("looking")
        return self.box
class Spoils(Standing):
    def init(self, image, box):
        box[:] = -1
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module of trackers in the working directory."""
    name = f"trackers_of_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    return name


@pytest.mark.parametrize(("name", "blue_at"), [("Standing", 2), ("Bgr", 0), ("Pil", 2)])
def test_a_class_gets_the_colours_that_it_asks_for(module: str, name: str, blue_at: int) -> None:
    if name == "Pil":
        pytest.importorskip("PIL")
    tracker: Any = choose(f"{module}:{name}").open()
    tracker.init(FRAME, BOX)
    image = tracker._tracker.image
    assert isinstance(image, np.ndarray) is (name != "Pil")
    assert np.asarray(image).shape == (48, 64, 3)
    assert np.asarray(image)[0, 0].argmax() == blue_at
    assert tracker.update(FRAME).box == tuple(BOX)


def test_a_class_cannot_spoil_the_labels(module: str) -> None:
    box = BOX.copy()
    choose(f"{module}:Spoils").open().init(FRAME, box)
    assert box.tolist() == BOX.tolist()


def test_what_a_class_prints_does_not_mix_with_results(module: str, capsys: pytest.CaptureFixture[str]) -> None:
    tracker = choose(f"{module}:Talks").open()
    tracker.init(FRAME, BOX)
    tracker.update(FRAME)
    assert capsys.readouterr() == ("", "loading\nlooking\n")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Missing", "cannot be opened"),
        ("NeedsAnArgument", "cannot be opened .*weights.*built without arguments"),
        ("NoUpdate", r"has no update\(\)"),
        ("Grey", "image_format 'grey': known are rgb, bgr, pil"),
    ],
)
def test_a_class_that_cannot_be_used(module: str, name: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        choose(f"{module}:{name}").open()
    with pytest.raises(UserError, match=r"'nowhere_at_all:Class' cannot be opened \(ModuleNotFoundError"):
        choose("nowhere_at_all:Class").open()


@pytest.mark.parametrize(
    ("name", "message"),
    [("Fails", r"failed in update\(\) \(ValueError: no such thing\)"), ("Nothing", "returned None: a box x,y,w,h")],
)
def test_a_class_that_fails_is_named(module: str, name: str, message: str) -> None:
    tracker = choose(f"{module}:{name}").open()
    tracker.init(FRAME, BOX)
    with pytest.raises(UserError, match=message):
        tracker.update(FRAME)


def test_keys_reach_the_constructor_with_their_types(module: str) -> None:
    tracker: Any = choose(f"module:{module}:Keyed,weights=a.pth,scale=0.5,deep=true,layers=3").open()
    assert tracker._tracker.keys == {"weights": "a.pth", "scale": 0.5, "deep": True, "layers": 3}


def test_an_edited_class_is_another_tracker(module: str, tmp_path: Path) -> None:
    tracker = choose(f"{module}:Keyed,scale=2")
    before = tracker.identity()
    assert before == choose(f"module:{module}:Keyed,scale=2").identity()
    path = tmp_path / f"{module}.py"
    path.write_text(path.read_text().replace("return self.box", "return self.box + 1"))
    assert tracker.identity() != before


@pytest.mark.parametrize("text", ["module:mean_shift", "module::Class", "module:pkg.mod:"])
def test_a_name_without_class_or_module_says_what_is_missing(text: str) -> None:
    with pytest.raises(UserError, match=r"names no class: write module:pkg\.mod:Class"):
        choose(text).open()


def test_a_class_without_a_score_invents_none(module: str) -> None:
    tracker = choose(f"{module}:Standing").open()
    tracker.init(FRAME, BOX)
    track = tracker.update(FRAME)
    assert (track.score, track.state) == (None, None)

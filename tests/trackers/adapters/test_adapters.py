from __future__ import annotations

import ast
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.trackers.trax import adapter
from psiamfcpp.trackers.trax.adapter import adapter_files, adapters, describe_adapters, open_adapter

from .checkouts import CHECKOUTS, make_checkout

# a worker process each
pytestmark = pytest.mark.slow

FOLDER = adapter._FOLDER
NAMES = sorted(CHECKOUTS)
# what `update` returns with a score in the originals
SCORES = {"transt": 0.75, "automatch": 0.5, "siamrcnn": 0.9}


def red(x: int, y: int) -> Image:
    """A blue-grey frame with a red rectangle of 30 by 20 pixels."""
    frame = np.full((120, 160, 3), (120, 90, 60), np.uint8)
    frame[y : y + 20, x : x + 30] = (0, 0, 255)
    return frame


@pytest.fixture
def changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of the adapters that a test may change."""
    folder = tmp_path / "adapters"
    shutil.copytree(FOLDER, folder, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(adapter, "_FOLDER", folder)
    adapters.cache_clear()
    yield folder
    adapters.cache_clear()


def change(folder: Path, name: str, old: str, new: str) -> None:
    path = folder / f"{name}.py"
    text = path.read_text()
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))
    adapters.cache_clear()


def test_every_adapter_has_a_stand_in() -> None:
    assert sorted(adapters()) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_an_adapter_follows_a_target_and_then_another(tmp_path: Path, name: str) -> None:
    tracker = open_adapter(name, make_checkout(tmp_path, name), threads=1)
    try:
        for x, y in ((20, 30), (60, 50)):
            assert tracker.init(red(x, y), (x, y, 30, 20)).box == (x, y, 30, 20)
            for step in (3, 6):
                track = tracker.update(red(x + step, y - step))
                assert track.box == (x + step, y - step, 30, 20)
                assert track.score == SCORES.get(name)
    finally:
        tracker.close()


@pytest.mark.parametrize("name", NAMES)
def test_a_wrong_colour_order_is_seen(tmp_path: Path, changed: Path, name: str) -> None:
    colour = adapters()[name]["colour"]
    change(changed, name, f'"colour": "{colour}"', '"colour": "{}"'.format({"rgb": "bgr", "bgr": "rgb"}[colour]))
    tracker = open_adapter(name, make_checkout(tmp_path, name), threads=1)
    with pytest.raises(UserError, match=f"adapter:{name}.*wrong colour order"):
        tracker.init(red(20, 30), (20, 30, 30, 20))


@pytest.mark.parametrize("name", NAMES)
def test_a_wrong_box_convention_is_seen(tmp_path: Path, changed: Path, name: str) -> None:
    origin = adapters()[name]["origin"]
    change(changed, name, f'"origin": {origin}', f'"origin": {1 - origin}')
    tracker = open_adapter(name, make_checkout(tmp_path, name), threads=1)
    with pytest.raises(UserError, match=f"adapter:{name}.*wrong convention"):
        tracker.init(red(20, 30), (20, 30, 30, 20))


@pytest.mark.parametrize("name", ["siamgat", "prdimp18", "d3s"])
@pytest.mark.parametrize(
    ("lost", "text"), [("None", "returned"), ("[1, 2, 3]", "returned"), ("[1, 2, float('nan'), 4]", "not finite")]
)
def test_lost_output_is_seen(tmp_path: Path, name: str, lost: str, text: str) -> None:
    options = make_checkout(tmp_path, name, lost=True)
    path = Path(options["checkout"]) / "standin.py"
    path.write_text(path.read_text().replace("LOST = None", f"LOST = {lost}"))
    tracker = open_adapter(name, options, threads=1)
    tracker.init(red(20, 30), (20, 30, 30, 20))
    with pytest.raises(UserError, match=f"adapter:{name}.*in frame 2.*{text}"):
        tracker.update(red(20, 30))


def test_what_a_tracker_prints_stays_out_of_the_protocol(tmp_path: Path) -> None:
    options = make_checkout(tmp_path, "siamgat")
    path = Path(options["checkout"]) / "pysot/tracker/siamgat_tracker.py"
    noise = "import os; print('@@TRAX:quit'); os.system('echo @@TRAX:quit')"
    path.write_text(path.read_text().replace('        return {"bbox"', f'        {noise}\n        return {{"bbox"'))
    tracker = open_adapter("siamgat", options, threads=1)
    tracker.init(red(20, 30), (20, 30, 30, 20))
    assert tracker.update(red(23, 30)).box == (23, 30, 30, 20)
    tracker.close()


def test_threads_and_seeds_are_set_before_each_target(tmp_path: Path) -> None:
    options = make_checkout(tmp_path, "siamgat")
    path = Path(options["checkout"]) / "pysot/tracker/siamgat_tracker.py"
    told = "import torch, random, numpy\n        drawn = [random.random(), numpy.random.rand()]\n"
    told += '        return {"bbox": [len(torch.utils.seeds), torch.utils.threads, drawn[0] * 100, drawn[1] * 100]}'
    path.write_text(re.sub(r'return \{"bbox".*\}', told, path.read_text()))
    tracker = open_adapter("siamgat", options, threads=3)
    seen = []
    for _ in range(2):
        tracker.init(red(20, 30), (20, 30, 30, 20))
        seen.append(tracker.update(red(20, 30)).box)
    tracker.close()
    (first, threads, *drawn), (second, _, *again) = seen
    assert threads == 3
    assert second == first + 1
    assert drawn == again


@pytest.mark.parametrize(
    ("change_to", "text"),
    [
        ({"checkout": ""}, "adapter:siamgat needs checkout, a copy of https://github.com/ohhhyeahhh/SiamGAT"),
        ({"weights": ""}, "adapter:siamgat needs weights, the model for OTB100"),
        ({"checkout": "/nowhere"}, "checkout /nowhere of adapter:siamgat is no folder: clone"),
        ({"weights": "/nowhere.pth"}, "weights /nowhere.pth of adapter:siamgat do not exist: fetch"),
        ({"python": "/nowhere/python"}, "python /nowhere/python of adapter:siamgat does not exist"),
        ({"device": "tpu"}, "device 'tpu' of adapter:siamgat is unknown"),
        ({"timeout": "soon"}, "timeout 'soon' of adapter:siamgat is no number"),
        ({"timeout": "-1"}, "timeout '-1' of adapter:siamgat is no number"),
    ],
)
def test_options_that_cannot_be_used(tmp_path: Path, change_to: dict[str, str], text: str) -> None:
    with pytest.raises(UserError, match=re.escape(text)):
        open_adapter("siamgat", {**make_checkout(tmp_path, "siamgat"), **change_to})


def test_an_unknown_adapter_lists_the_known() -> None:
    with pytest.raises(UserError, match="unknown adapter 'siamfc': there are automatch, d3s, hift"):
        open_adapter("siamfc", {})


def test_a_missing_module_is_named(tmp_path: Path) -> None:
    options = make_checkout(tmp_path, "lighttrack")
    (Path(options["checkout"]) / "lib/tracker/lighttrack.py").write_text("import no_such_module_here\n")
    with pytest.raises(UserError, match=r"adapter:lighttrack.*No module named 'no_such_module_here'"):
        open_adapter("lighttrack", options, threads=1)


def test_random_weights_must_be_asked_for(tmp_path: Path) -> None:
    options = make_checkout(tmp_path, "siamgat")
    tracker = open_adapter("siamgat", {**options, "weights": "random"}, threads=1)
    tracker.close()
    assert adapter_files("siamgat", {**options, "weights": "random"}) == []


def test_identity_follows_the_content_of_files_and_not_their_place(tmp_path: Path) -> None:
    identities = []
    for folder, weights in (("a", "the weights"), ("b", "the weights"), ("c", "others")):
        options = make_checkout(tmp_path / folder, "d3s")
        Path(options["weights"]).write_text(weights)
        if weights == "others":
            path = Path(options["checkout"]) / "standin.py"
            path.write_text(path.read_text().replace('== "the weights"', '== "others"'))
        tracker = open_adapter("d3s", options, threads=1)
        tracker.close()
        identities.append(tracker.identity)
        assert tracker.name == "d3s"
    assert identities[0] == identities[1] != identities[2]


@pytest.mark.parametrize("name", NAMES)
def test_an_adapter_states_what_it_was_written_for(name: str) -> None:
    facts = adapters()[name]
    assert facts["repository"].startswith("https://github.com/")
    assert re.fullmatch("[0-9a-f]{40}", facts["commit"])
    assert facts["colour"] in ("rgb", "bgr") and facts["origin"] in (0, 1)
    assert all(facts[key] for key in ("name", "licence", "weights", "modules", "threads", "seeds", "notes"))


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_adapters_are_python_3_6_and_import_nothing_of_ours(path: Path) -> None:
    tree = ast.parse(path.read_text(), feature_version=(3, 6))
    imported = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            imported.append(node.module or "")
    assert not [name for name in imported if name.startswith(("psiamfcpp", "__future__", "dataclasses"))]


def test_the_description_says_what_is_missing(tmp_path: Path) -> None:
    options = make_checkout(tmp_path, "siamrcnn")
    rows = {row["adapter"]: row for row in describe_adapters({"siamrcnn": options})}
    assert sorted(rows) == NAMES
    missing = " ".join(rows["transt"]["missing"])
    assert "git clone https://github.com/chenxin-dlut/TransT; git checkout 2793ef31f8" in missing
    assert "transt.pth" in missing
    # checkout and weights are there
    assert not [text for text in rows["siamrcnn"]["missing"] if not text.startswith("modules: ")]
    unusable = describe_adapters({"lighttrack": {"python": "/nowhere/python"}})
    (row,) = (row for row in unusable if row["adapter"] == "lighttrack")
    assert "modules: torch, cv2, yaml, shapely" in row["missing"]

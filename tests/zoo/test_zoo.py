"""Shipped weights: names, and what every shipped file must be."""

from __future__ import annotations

from pathlib import Path

import pytest

from psiamfcpp import UserError, zoo
from psiamfcpp.models import load
from psiamfcpp.runtime import open_engine
from psiamfcpp.runtime.graph_file import precision

FOLDER = Path(zoo.__file__).parent


@pytest.fixture
def shelf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A zoo of two models."""
    folder = tmp_path / "zoo"
    folder.mkdir()
    for name in ("big-one.safetensors", "small-one.safetensors", "small-one.md", "notes.txt"):
        (folder / name).touch()
    monkeypatch.setattr(zoo, "_FOLDER", folder)
    monkeypatch.setattr(zoo, "_WEIGHTS", "no_such_package")
    return folder


def test_names_are_those_of_the_weights(shelf: Path) -> None:
    assert zoo.names() == ["big-one", "small-one"]
    assert zoo.weights_path("small-one") == shelf / "small-one.safetensors"


def test_a_file_may_lie_anywhere(shelf: Path, tmp_path: Path) -> None:
    path = tmp_path / "mine.safetensors"
    path.touch()
    assert zoo.weights_path(path) == zoo.weights_path(str(path)) == path


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("smal-one", "model 'smal-one' is neither a file nor a shipped model: did you mean 'small-one'"),
        ("zzz", "shipped models are big-one, small-one"),
        ("notes", "neither a file"),
        ("", "neither a file"),
        (".", "neither a file"),  # a folder is no model
        ("../zoo/small-one", "neither a file"),
    ],
)
def test_an_unknown_name_is_answered_with_known_ones(shelf: Path, name: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        zoo.weights_path(name)


@pytest.mark.slow
def test_every_shipped_model_loads_is_small_and_has_a_card() -> None:
    for name in zoo.names():
        path = zoo.weights_path(name)
        assert path.stat().st_size <= 20e6, f"{name} is above 20 MB"
        card = FOLDER / f"{name}.md"
        assert card.is_file(), f"{name} has no model card"
        assert card.read_text().strip(), f"the card of {name} is empty"
        assert load(name).spec.provenance, f"{name} does not say where it comes from"


def test_the_package_holds_the_pruned_graphs_and_the_weights_the_rest() -> None:
    own = {path.name for path in FOLDER.iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert own == {
        "plightfc-int8",
        "plightfc-s-int8",
        "psiamfcpp-alexnet-int8",
        "psiamfcpp-alexnet-n-int8",
        "psiamfcpp-alexnet-s-int8",
    }
    assert set(zoo._ELSEWHERE) == {*zoo.names(), *zoo.graph_names()} - own


@pytest.mark.parametrize("name", zoo._ELSEWHERE)
def test_a_model_of_the_weights_is_named_where_they_are_missing(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(zoo, "_WEIGHTS", "no_such_package")
    assert name not in zoo.names() + zoo.graph_names()
    with pytest.raises(UserError, match=rf"'{name}' is part of psiamfcpp-weights, .* pip install \./weights"):
        zoo.weights_path(name)


def test_no_card_is_left_without_its_model() -> None:
    assert {path.stem for path in FOLDER.glob("*.md")} <= set(zoo.names())


@pytest.mark.slow
def test_every_folder_of_graphs_is_of_a_shipped_model_and_small() -> None:
    assert zoo.DEFAULT_MODEL in {*zoo.names(), *zoo.graph_names()}
    for name in zoo.graph_names():
        folder = zoo.graph_folder(name)
        assert folder is not None
        checkpoint = load(name.removesuffix("-int8"))
        engine = open_engine(name, "onnx", 1)
        assert engine.spec == checkpoint.spec, f"{name} was exported from another checkpoint: export it again"
        assert precision(folder) == ("int8" if name.endswith("-int8") else "fp32")
        for path in folder.iterdir():
            assert path.stat().st_size <= 20e6, f"{path.name} of {name} is above 20 MB"


def test_a_folder_of_graphs_is_known_by_name_and_by_path(shelf: Path, tmp_path: Path) -> None:
    (shelf / "small-one-int8").mkdir()
    (shelf / "small-one-int8" / "search.onnx").touch()
    (shelf / "empty").mkdir()
    assert zoo.graph_names() == ["small-one-int8"]
    assert zoo.graph_folder("small-one-int8") == shelf / "small-one-int8"
    assert zoo.graph_folder("small-one") is zoo.graph_folder("") is zoo.graph_folder(tmp_path) is None
    (tmp_path / "search.xml").touch()
    assert zoo.graph_folder(str(tmp_path)) == tmp_path
    with pytest.raises(
        UserError, match=r"'small-one-int8' holds graphs only, and this needs a checkpoint: shipped models are big"
    ):
        zoo.weights_path("small-one-int8")


def test_the_default_is_a_pruned_network_in_eight_bits() -> None:
    from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
    from psiamfcpp.runtime import open_engine

    engine = open_engine(threads=1)
    assert engine.precision == "int8"
    assert any(engine.spec.widths[name] < full for name, full in ARCHITECTURE.groups.items())

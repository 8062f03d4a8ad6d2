from __future__ import annotations

import re
from pathlib import Path

import pytest

from psiamfcpp import datasets
from psiamfcpp.errors import UserError

DOCS = Path(__file__).parents[2] / "docs"


def test_read_takes_the_reader_of_the_kind(lay):
    root = lay({"TRAIN_0/anno/a.txt": "1,2,3,4\n"}, empty=("TRAIN_0/frames/a/0.jpg",))
    (sequence,) = datasets.read("trackingnet", root)
    assert (sequence.name, len(sequence)) == ("a", 1)


@pytest.mark.parametrize("kind", datasets.READERS)
def test_every_kind_is_documented(kind: str):
    assert re.search(rf"^\|.*`{kind}`.*\|", (DOCS / "training.md").read_text(), re.MULTILINE)


def test_unknown_kind_lists_the_known_ones(tmp_path: Path):
    with pytest.raises(UserError, match=r"unknown dataset layout 'voc': known are .*coco"):
        datasets.read("voc", tmp_path)


@pytest.mark.parametrize("kind", datasets.READERS)
def test_missing_root(kind: str, tmp_path: Path):
    with pytest.raises(UserError, match="nowhere does not exist"):
        datasets.read(kind, tmp_path / "nowhere")


@pytest.mark.parametrize("kind", datasets.READERS)
def test_an_empty_root_shows_the_layout_on_one_line(kind: str, tmp_path: Path):
    with pytest.raises(UserError, match="expected layout: <root>/") as caught:
        datasets.read(kind, tmp_path)
    assert "\n" not in str(caught.value)

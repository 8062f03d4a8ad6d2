"""Every command in the README and in docs/ is one that exists, with options that it has."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from psiamfcpp.cli import COMMANDS
from psiamfcpp.cli.output import parse_box
from psiamfcpp.demo.clip import render

from .conftest import Run

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md")), *sorted(ROOT.glob("src/psiamfcpp/zoo/*.md"))]
SHELLS = {"", "bash", "console", "sh", "shell"}


def commands(page: str) -> list[list[str]]:
    """The words after ``psiamfcpp`` of each call in fenced shell blocks and in inline code."""
    texts = []
    for language, block in re.findall(r"^ *```(\S*)\n(.*?)^ *```", page, re.MULTILINE | re.DOTALL):
        if language in SHELLS:
            lines = block.replace("\\\n", " ").splitlines()
            # where some lines have a prompt, the others are what was answered
            prompted = [line.split("$ ", 1)[1] for line in lines if line.lstrip().startswith("$ ")]
            texts += prompted or lines
    inline = re.sub(r"^ *```.*?^ *```", "", page, flags=re.MULTILINE | re.DOTALL)
    texts += re.findall(r"`([^`\n]+)`", inline)
    found = []
    for text in texts:
        for part in re.split(r"&&|\|\||[|;]", text):
            try:
                words = shlex.split(part, comments=True)
            except ValueError:
                # an apostrophe: this is prose, or an answer
                continue
            # "psiamfcpp", ".venv/bin/psiamfcpp", "python -m psiamfcpp", "torchrun ... -m psiamfcpp"
            while words and re.fullmatch(r"\w+=\S*", words[0]):
                words = words[1:]
            if words and Path(words[0]).name == "psiamfcpp":
                found.append(words[1:])
            elif "-m" in words[:-1] and words[words.index("-m") + 1] == "psiamfcpp":
                found.append(words[words.index("-m") + 2 :])
    # a bare name is the package, and a word in capitals stands for any command
    return [words for words in found if words and not words[0].isupper()]


def test_commands_are_found_wherever_they_stand() -> None:
    page = """Install `psiamfcpp`, then `psiamfcpp info MODEL --json`; `psiamfcpp COMMAND --help` lists it's options.
```
pip install psiamfcpp && .venv/bin/psiamfcpp demo  # renders
```
```console
$ OMP_NUM_THREADS=1 psiamfcpp track 'a b.mp4' \\
    --box 1,2,3,4 | head
psiamfcpp: not a command, but an answer
```
```python
psiamfcpp.Tracker()  # psiamfcpp nonsense
```
  ```sh
  torchrun --nproc-per-node 2 -m psiamfcpp train --data stills:x
  ```
"""
    assert commands(page) == [
        ["demo"],
        ["track", "a b.mp4", "--box", "1,2,3,4"],
        ["train", "--data", "stills:x"],
        ["info", "MODEL", "--json"],
    ]


@pytest.fixture(scope="module")
def known_options() -> dict[str, set[str]]:
    """The options of each command whose help was asked for."""
    return {}


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_documented_commands_exist_with_their_options(run: Run, page: Path, known_options: dict[str, set[str]]) -> None:
    for words in commands(page.read_text()):
        if words[0] in ("-h", "--help", "--version"):
            continue
        shown = "psiamfcpp " + " ".join(words)
        assert words[0] in COMMANDS, shown
        if words[0] not in known_options:
            shown_help = run(words[0], "--help").out
            known_options[words[0]] = set(re.findall(r"(?<![\w-])--?[a-z][a-z0-9-]*", shown_help))
        for word in words[1:]:
            if re.match(r"--?[a-z]", word):
                assert word.split("=")[0] in known_options[words[0]], f"{shown}: {word}"


@pytest.mark.slow
def test_the_readmes_box_is_that_of_the_demos_car() -> None:
    shown = next(render(4, 300)).box
    lines = re.findall(r"demo-clip\.mp4 --box (\S+)", (ROOT / "README.md").read_text())
    python = re.findall(r"boxes = \[\(([\d, ]+)\)\]", (ROOT / "README.md").read_text())
    assert len(lines) == len(python) == 1
    for box in (lines[0], python[0]):
        assert parse_box(box) == pytest.approx(shown, abs=0.5)

"""Words that this project does not use in prose, each with what is written instead."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "psiamfcpp"
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("weights/*.md"), *SOURCE.glob("zoo/*.md")]
MODULES = [*SOURCE.glob("**/*.py")]

INSTEAD = {
    r"mend(s|ed|ing)?": "fix",
    r"parted": "separated",
    r"(take|takes|took|taken|taking) (a target |it |them )?up(?! to| space)": "re-acquire, start",
    r"(let|lets|letting) (it |them |[\w ]*targets? )?go": "release",
    r"told|tells": "notified, sent, states",
    r"pictures?": "image, plot",
    r"an? (box|column|entry|file|folder|line|name|row|thread|value) an? \w+": "one box per line",
    r"x,y,w,h a \w+": "x,y,w,h per frame",
    r"so many": "N",
}
ANY = re.compile(rf"\b({'|'.join(INSTEAD)})\b", re.IGNORECASE)
PATTERNS = {re.compile(rf"\b({word})\b", re.IGNORECASE): better for word, better in INSTEAD.items()}


def prose_of_page(text: str) -> Iterator[tuple[int, str]]:
    """Lines of a page with their numbers, without code."""
    fenced = False
    for number, line in enumerate(text.splitlines(), start=1):
        if line.lstrip().startswith("```"):
            fenced = not fenced
        elif not fenced and not line.startswith("    "):
            yield number, re.sub(r"`[^`]*`", "", line)


def prose_of_module(text: str) -> Iterator[tuple[int, str]]:
    """Comments and strings of a module: docstrings, messages, descriptions of options."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string
    for node in ast.walk(ast.parse(text)):
        # a string without a blank is a name, such as that of an option
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.lineno, re.sub(r"`[^`]*`", "", node.value)


def found_in(prose: Iterator[tuple[int, str]]) -> list[str]:
    """What is to be written otherwise, with the line and what to write."""
    return [
        f"line {number}: {match[0]!r}, write: {better}"
        for number, text in prose
        for pattern, better in PATTERNS.items()
        for match in pattern.finditer(text)
    ]


@pytest.mark.parametrize(("paths", "prose"), [(PAGES, prose_of_page), (MODULES, prose_of_module)])
def test_pages_and_modules_use_the_terms_of_the_field(
    paths: list[Path], prose: Callable[[str], Iterator[tuple[int, str]]]
) -> None:
    texts = {path.relative_to(ROOT): path.read_text() for path in paths}
    # Only a text that holds such a word anywhere is taken apart.
    found = {str(path): found_in(prose(text)) for path, text in texts.items() if ANY.search(text)}
    assert {path: words for path, words in found.items() if words} == {}


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("Mend the labels.", 1),
        ("Targets are taken up again, others let go.", 2),
        ("One box per line; a box a line.", 1),
        ("Work took up to 20 % longer, in a line of a file.", 0),
        ("`report --picture`, recommended and departed", 0),
        ("```\nmend\n```\nfixed", 0),
    ],
)
def test_words_are_found_in_prose_alone(text: str, count: int) -> None:
    assert len(found_in(prose_of_page(text))) == count


def test_comments_docstrings_and_messages_are_prose_and_names_are_not() -> None:
    module = '"""Told so."""\npicture = "--picture"  # mend\nraise ValueError(f"{picture} a row a frame")\n'
    assert len(found_in(prose_of_module(module))) == 3

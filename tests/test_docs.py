"""The pages: each is in the navigation, and each link leads to a file of the repository and to a heading in it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCS = sorted((ROOT / "docs").glob("**/*.md"))
CARDS = sorted((ROOT / "src/psiamfcpp/zoo").glob("*.md"))
TOP = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")]
# Made when the site is built, from files that lie elsewhere.
GENERATED = {"reference/cli.md", "changelog.md", "contributing.md", *(f"models/{card.name}" for card in CARDS)}
SCREEN = 60


def anchors(page: Path) -> set[str]:
    """Ids of a page's headings, as mkdocs and code hosts make them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def links(page: Path) -> list[tuple[str, str]]:
    """Target and anchor of each link of a page that stays in the repository."""
    text = re.sub(r"^ *```.*?^ *```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    return re.findall(r"\]\((?!https?:)([^)#\s]*)#?([^)\s]*)\)", text)


def test_every_page_is_in_the_navigation_once() -> None:
    named = re.findall(r"[\w/.-]+\.md", (ROOT / "mkdocs.yml").read_text())
    written = {str(page.relative_to(ROOT / "docs")) for page in DOCS}
    assert len(named) == len(set(named))
    assert set(named) == written | GENERATED


@pytest.mark.parametrize("page", [*DOCS, *CARDS, *TOP], ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target, anchor in links(page):
        found = (page.parent / target).resolve() if target else page
        assert found.exists(), f"{target} does not exist"
        if anchor:
            assert anchor in anchors(found), f"{target} has no heading #{anchor}"


@pytest.mark.parametrize("card", CARDS, ids=lambda card: card.stem)
def test_a_card_fits_one_screen_and_states_its_licence(card: Path) -> None:
    text = card.read_text()
    assert text.count("\n") <= SCREEN
    assert "**Licence.**" in text
    assert "research terms" in text

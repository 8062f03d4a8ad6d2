"""The pages: the navigation holds each of them, links lead to files and headings, images are small."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest
from PIL import Image

from psiamfcpp.demo.clip import DemoFrame
from psiamfcpp.errors import UserError
from psiamfcpp.version import __version__
from psiamfcpp.video.writer import VideoWriter

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


def moving_image() -> ModuleType:
    """The script that makes the README's image."""
    spec = importlib.util.spec_from_file_location("make_moving_image", ROOT / "docs/make_moving_image.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_moving_image_shows_every_third_frame_at_the_pace_of_the_video(
    tmp_path: Path, rendered_clip: list[DemoFrame], capsys: pytest.CaptureFixture[str]
) -> None:
    height, width = rendered_clip[0].image.shape[:2]
    with VideoWriter(tmp_path / "demo.mp4", 30, (width, height)) as writer:
        for shot in rendered_clip[:7]:
            writer.write(shot.image)
    moving_image().main(tmp_path / "demo.mp4", tmp_path / "demo.webp", width=160)
    with Image.open(tmp_path / "demo.webp") as image:
        assert (image.n_frames, image.size) == (3, (160, round(height * 160 / width)))
        image.load()
        assert image.info["duration"] == 100
    assert "3 images" in capsys.readouterr().out


def test_an_image_that_is_too_large_is_not_written(
    tmp_path: Path, rendered_clip: list[DemoFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    height, width = rendered_clip[0].image.shape[:2]
    with VideoWriter(tmp_path / "demo.mp4", 30, (width, height)) as writer:
        writer.write(rendered_clip[0].image)
    script = moving_image()
    monkeypatch.setattr(script, "LARGEST", 100)
    with pytest.raises(UserError, match="more than 100: raise --every or lower --quality"):
        script.main(tmp_path / "demo.mp4", tmp_path / "demo.webp")
    assert not (tmp_path / "demo.webp").exists()


def test_images_of_the_pages_are_small() -> None:
    sizes = {path.name: path.stat().st_size for path in (ROOT / "docs/images").iterdir()}
    assert sizes
    assert max(sizes.values()) <= 3_000_000, sizes


def test_the_version_is_the_same_everywhere() -> None:
    stated = {
        "CITATION.cff": re.findall(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE),
        "weights": re.findall(r'^version = "(.*)"$', (ROOT / "weights/pyproject.toml").read_text(), re.MULTILINE),
        "CHANGELOG.md": re.findall(r"^## \[(\d.*?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[:1],
    }
    assert all(found == [__version__] for found in stated.values()), stated

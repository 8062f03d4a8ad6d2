"""What mkdocs needs beside the pages: pages that are made, and links that leave the folder.

The reference of the command line is the help of the commands. Model cards, changelog and contributing guide lie
elsewhere in the repository, where they are read too; the site shows them as pages.
"""

from __future__ import annotations

import contextlib
import io
import os
import posixpath
import re
from pathlib import Path
from unittest import mock

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from psiamfcpp import cli

ROOT = Path(__file__).parents[1]
ZOO = "src/psiamfcpp/zoo"
# Page of the site by file of the repository.
ELSEWHERE = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "README.md": "index.md",
    **{f"{ZOO}/{path.name}": f"models/{path.name}" for path in sorted((ROOT / ZOO).glob("*.md"))},
}
_LINK = re.compile(r"(?P<image>!?)\[(?P<text>[^\]]*)\]\((?P<target>[^)\s:]+?)(?P<anchor>#[^)\s]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made, and the cards' plots."""
    pages = {page: (ROOT / source).read_text() for source, page in ELSEWHERE.items() if source != "README.md"}
    for page, text in {**pages, "reference/cli.md": command_line()}.items():
        files.append(File.generated(config, page, content=text))
    for plot in sorted((ROOT / ZOO).glob("*.png")):
        files.append(File.generated(config, f"models/{plot.name}", abs_src_path=str(plot)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links to files of the repository into links to pages, to the repository's own site, or into plain text."""
    here = {page: source for source, page in ELSEWHERE.items()}.get(page.file.src_uri, f"docs/{page.file.src_uri}")

    def turned(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(here), link["target"]))
        anchor = link["anchor"] or ""
        if link["image"]:
            shown = f"models/{posixpath.basename(target)}" if target.startswith(ZOO) else ""
            return f"![{link['text']}]({shown})" if shown and page.file.src_uri.count("/") == 0 else link[0]
        if target in ELSEWHERE or target.startswith("docs/"):
            target = ELSEWHERE.get(target, target.removeprefix("docs/"))
            return f"[{link['text']}]({posixpath.relpath(target, posixpath.dirname(page.file.src_uri) or '.')}{anchor})"
        if not (ROOT / target).exists():
            return link[0]  # which mkdocs complains about
        if config.repo_url:
            return f"[{link['text']}]({config.repo_url.rstrip('/')}/blob/main/{target})"
        return link["text"] if link["text"] == target else f"{link['text']} (`{target}`)"

    # blocks of code are left as they are
    parts = re.split(r"(^ *```.*?^ *```)", markdown, flags=re.MULTILINE | re.DOTALL)
    return "".join(part if number % 2 else _LINK.sub(turned, part) for number, part in enumerate(parts))


def command_line() -> str:
    """Return the reference of the commands: each with what it prints for ``--help``."""
    text = ["# Command line", "", "What `psiamfcpp COMMAND --help` prints, for each command."]
    for command, what in cli.COMMANDS.items():
        shown = io.StringIO()
        with mock.patch.dict(os.environ, COLUMNS="96", NO_COLOR="1"), contextlib.redirect_stdout(shown):
            cli.main([command, "--help"])
        text += [
            "",
            f"## {command}",
            "",
            f"{what[0].upper()}{what[1:]}.",
            "",
            "```text",
            _plain(shown.getvalue()),
            "```",
        ]
    return "\n".join(text) + "\n"


def _plain(shown: str) -> str:
    """Return help without colours and without blanks at the ends of lines."""
    return "\n".join(line.rstrip() for line in re.sub(r"\x1b\[[0-9;]*m", "", shown).strip().splitlines())

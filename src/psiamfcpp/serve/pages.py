"""The files of the pages, and the headers that they are sent with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import resources
from typing import Any

from fastapi import FastAPI, Response

# Nothing from elsewhere is loaded, and no other page may frame this one.
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_KINDS = {"html": "text/html", "js": "text/javascript", "css": "text/css"}


def add_files(app: FastAPI, files: Mapping[str, str]) -> None:
    """Serve files of the folder ``page``.

    Args:
        app: what serves them.
        files: names in the folder, by the path that they are served under.
    """
    folder = resources.files("psiamfcpp.serve") / "page"

    def serving(name: str) -> Callable[[], Any]:
        text, kind = (folder / name).read_text("utf-8"), _KINDS[name.rpartition(".")[2]]

        async def page() -> Response:
            return Response(text, media_type=kind, headers=HEADERS)

        return page

    for path, name in files.items():
        app.get(path, include_in_schema=False)(serving(name))

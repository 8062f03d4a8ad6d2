"""The report in a real browser, as wide as a desk and as a phone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import pytest


@pytest.mark.slow
def test_the_report_is_readable_on_a_desk_and_on_a_phone(browser: Any, report: list[Path], tmp_path: Path) -> None:
    for width, height in ((1280, 900), (390, 844)):
        page = browser.new_page(viewport={"width": width, "height": height})
        requests: list[str] = []
        errors: list[str] = []
        page.on("request", lambda request, seen=requests: seen.append(request.url))
        page.on("console", lambda message, seen=errors: seen.append(message.text))
        page.goto(report[0].as_uri())
        page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
        # nothing from elsewhere, every picture drawn, and no scrolling sideways but inside of tables
        assert {url.partition(":")[0] for url in requests} <= {"file", "data"}
        assert errors == []
        assert page.evaluate("[...document.images].every(i => i.complete && i.naturalWidth > 0)")
        assert page.evaluate("document.documentElement.scrollWidth") == width
        assert page.evaluate(
            "[...document.querySelectorAll('p')].every(e => e.getBoundingClientRect().right <= innerWidth)"
        )
        sizes = page.evaluate("[...document.querySelectorAll('p, td, th')].map(e => getComputedStyle(e).fontSize)")
        assert min(float(size.removesuffix("px")) for size in sizes) >= 12
        # one convention at a time, and the other on demand, without a script
        assert page.evaluate("document.scripts.length") == 0
        shown = "[...document.querySelectorAll('.{}')].filter(e => e.offsetHeight > 0).length"
        assert page.evaluate(shown.format("otb")) > 0
        assert page.evaluate(shown.format("got10k")) == 0
        page.locator("label[for=pick-got10k]").click()
        assert page.evaluate(shown.format("otb")) == 0
        assert page.evaluate(shown.format("got10k")) > 0
        assert page.locator("tr.published:visible").count() > 0
        picture = tmp_path / f"{width}.png"
        page.screenshot(path=picture, full_page=True)
        image = cv2.imread(str(picture))
        assert image.shape[1] == width
        assert image.shape[0] > height
        # all there is drawn: text, three colours of ranks and curves, and photographs
        assert len({tuple(colour) for colour in image[::7, ::7].reshape(-1, 3).tolist()}) > 100
        page.close()

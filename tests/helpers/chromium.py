"""Open HTML pages in the installed Chromium; tests marked `NEEDS_CHROMIUM` are skipped if none is installed."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
NEEDS_CHROMIUM = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium, such as Debian's package chromium")
PHONE = 390
"""Width of a phone in pixels."""


@contextmanager
def chromium() -> Iterator[Callable[..., Any]]:
    """Start a browser; yield a function that opens an address in a window of a given width and colour scheme.

    At the end, check that no page had an error and that no local page requested a file from a server.
    """
    playwright = pytest.importorskip("playwright.sync_api", reason="needs the extra browser")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        problems: list[str] = []

        def record_requests(request: Any) -> None:
            if request.frame.url.startswith("file:") and request.url.startswith("http"):
                problems.append(request.url)

        def open_page(address: str, width: int = 1280, dark: bool = False, **options: Any) -> Any:
            scheme = "dark" if dark else "light"
            page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme, **options)
            page.set_default_timeout(60_000)
            page.on("pageerror", lambda error: problems.append(str(error)))
            page.on("console", lambda message: problems.append(message.text))
            page.on("request", record_requests)
            page.goto(address)
            return page

        yield open_page
        browser.close()
        assert not problems


def wait_until(page: Any, condition: str, seconds: float = 30) -> None:
    """Wait until a JavaScript expression is true.

    Playwright's `wait_for_function` calls `eval` in the page, which the page's security policy forbids.
    """
    end = time.monotonic() + seconds
    while not page.evaluate(condition):
        assert time.monotonic() < end, condition
        page.wait_for_timeout(20)


def check_fits_window(page: Any, width: int, dark: bool) -> None:
    """Assert that a page is no wider than its window, and that its background is dark if and only if `dark` is set."""
    assert page.evaluate("document.documentElement.scrollWidth") == width
    shade = page.evaluate("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")
    assert (max(shade) < 60) is dark

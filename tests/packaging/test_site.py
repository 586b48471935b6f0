"""Test the documentation as a whole: links and names exist, and the site builds without warnings or network access."""

from __future__ import annotations

import os
import pydoc
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.helpers.chromium import CHROMIUM, NEEDS_CHROMIUM
from tests.helpers.paths import ROOT
from tests.packaging.test_docs import DOCS, PAGES, table_rows

FILES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(DOCS / f"{page}.md" for page in PAGES)]
TEXTS = {path: path.read_text(encoding="utf-8") for path in FILES}
EVERY_FILE = pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())


def heading_anchors(text: str) -> set[str]:
    """Return the anchors that code hosts and the site give to a page's headings."""
    titles = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles}


@EVERY_FILE
def test_linked_files_and_headings_exist(path):
    for target in re.findall(r"\]\((?!https?://)(.*?)\)", TEXTS[path]):
        name, _, anchor = target.partition("#")
        file = (path.parent / name).resolve() if name else path
        assert file.is_file(), target
        if anchor:
            assert anchor in heading_anchors(TEXTS[file]), target


@EVERY_FILE
def test_make_targets_named_in_pages_exist(path):
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert set(re.findall(r"(?:`|^    )make ([a-z-]+)(?![a-z.-])", TEXTS[path], re.MULTILINE)) <= targets


def test_every_page_is_in_the_navigation():
    listed = re.findall(r"^ +- .*: ([\w/]+)\.md$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(PAGES)


def test_names_listed_in_the_api_page_exist():
    listed = re.findall(r"`([\w.]+)`: ((?:`[\w.]+`(?:, )?)+)", PAGES["api/index"])
    assert len(listed) >= 5
    for module, names in listed:
        for name in re.findall(r"`([\w.]+)`", names):
            assert pydoc.locate(f"{module}.{name}") is not None, (module, name)


def test_start_page_lists_all_extras():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    listed = {name for cells in table_rows("start", "extra") for name in cells[0].split(", ")}
    assert listed == project["optional-dependencies"].keys() - {"browser", "peers"}
    assert re.search(r"\[.*\bbrowser\b.*\]", project["optional-dependencies"]["dev"][0]), "tests of pages need it"


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """Build the site, with warnings as errors, and return its folder."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    process = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    assert "WARNING" not in process.stderr
    return folder


@pytest.mark.slow
def test_the_site_loads_nothing_from_other_hosts(site):
    pages = {path.relative_to(site).as_posix(): path.read_text(encoding="utf-8") for path in site.rglob("*.html")}
    assert {"index.html", "loading.html", "api/datasets.html"} <= pages.keys()
    for page, html in pages.items():
        assert not re.findall(r"<(?:script|img|link|iframe)[^>]+(?:src|href)=\"(?:https?:)?//[^>]*>", html), page
    assert 'id="icrl4aht_data.load_icrl4aht"' in pages["api/datasets.html"]
    assert "min_expert_return" in pages["api/datasets.html"], "signatures"
    assert 'href="notebooks/explore.html"' in pages["notebooks.html"], "a page, not JSON"
    assert 'id="one-history"' in pages["notebooks/explore.html"] and "data:image/png" in pages["notebooks/explore.html"]


@pytest.mark.slow
@NEEDS_CHROMIUM
def test_site_opened_from_disk_can_be_searched(site):
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page()
        page.goto((site / "start.html").as_uri())
        page.fill("input.md-search__input", "headroom")
        page.wait_for_selector(".md-search-result__item", state="attached", timeout=60_000)
        browser.close()

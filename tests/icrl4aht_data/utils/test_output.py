"""Test `check_output`: a file is replaced only on request, by a file of the same kind; links and folders never are."""

from __future__ import annotations

import pytest

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import PAGE_START, check_output


def test_check_output_allows_replacing_files_only_on_request(tmp_path):
    path = tmp_path / "file.png"
    check_output(path, overwrite=False)
    path.write_bytes(b"\x89PNG\r\n\x1a\n")
    check_output(path, overwrite=True)
    (tmp_path / "page.html").write_bytes(b"\n\n" + PAGE_START)
    check_output(tmp_path / "page.html", overwrite=True)
    with pytest.raises(OptionError, match=r"file\.png: exists; give another name, or use --overwrite to replace it"):
        check_output(path, overwrite=False)
    (tmp_path / "link.png").symlink_to(path)
    (tmp_path / "lost.png").symlink_to(tmp_path / "nothing")
    (tmp_path / "folder.png").mkdir()
    for name in ("link", "lost", "folder"):
        with pytest.raises(OptionError, match=f"{name}.png: expected a file, found a folder or a link"):
            check_output(tmp_path / f"{name}.png", overwrite=True)


@pytest.mark.parametrize("suffix", [".gif", ".html", ".htm", ".json", ".parquet", ".pdf", ".png", ".svg"])
def test_check_output_never_replaces_files_of_another_kind(tmp_path, suffix):
    path = tmp_path / f"mine{suffix}"
    for content in (b"", b"<!doctype html>\n<title>mine</title>", b"{}\n"):
        path.write_bytes(content)
        with pytest.raises(
            OptionError, match=rf"mine\{suffix}: not a \{suffix} file .* give another name, or remove it"
        ):
            check_output(path, overwrite=True)


def test_check_output_checks_the_named_files_of_a_folder(tmp_path):
    check_output(tmp_path / "new", False, ["report.md"])
    check_output(tmp_path, False, ["report.md"])
    (tmp_path / "notes.md").write_text("mine")
    with pytest.raises(OptionError, match="exists; give another folder, or use --overwrite to replace its files"):
        check_output(tmp_path, False, ["report.md"])
    (tmp_path / "report.md").write_text("old")
    check_output(tmp_path, True, ["report.md"])
    (tmp_path / "numbers.json").write_text('{\n "published": 1}')
    check_output(tmp_path, True, ["numbers.json"])
    (tmp_path / "page.html").mkdir()
    with pytest.raises(OptionError, match=r"page\.html: expected a file, found a folder or a link"):
        check_output(tmp_path, True, ["report.md", "page.html"])
    with pytest.raises(OptionError, match="expected a folder, found a file"):
        check_output(tmp_path / "notes.md", True, ["report.md"])

"""Test output checks: existing files are replaced only on request, links and folders never."""

from __future__ import annotations

import pytest

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import check_output


def test_check_output_allows_replacing_files_only_on_request(tmp_path):
    path = tmp_path / "file.png"
    check_output(path, overwrite=False)
    path.write_bytes(b"")
    check_output(path, overwrite=True)
    with pytest.raises(OptionError, match=r"file\.png: exists; give another name, or replace it by --overwrite"):
        check_output(path, overwrite=False)
    (tmp_path / "link.png").symlink_to(path)
    (tmp_path / "lost.png").symlink_to(tmp_path / "nothing")
    (tmp_path / "folder.png").mkdir()
    for name in ("link", "lost", "folder"):
        with pytest.raises(OptionError, match=f"{name}.png: a folder or a link is where a file is needed"):
            check_output(tmp_path / f"{name}.png", overwrite=True)


def test_check_output_checks_the_named_files_of_a_folder(tmp_path):
    check_output(tmp_path / "new", False, ["report.md"])
    check_output(tmp_path, False, ["report.md"])
    (tmp_path / "notes.md").write_text("mine")
    with pytest.raises(OptionError, match="exists; give another folder, or replace its files by --overwrite"):
        check_output(tmp_path, False, ["report.md"])
    (tmp_path / "report.md").write_text("old")
    check_output(tmp_path, True, ["report.md"])
    (tmp_path / "page.html").mkdir()
    with pytest.raises(OptionError, match=r"page\.html: a folder or a link"):
        check_output(tmp_path, True, ["report.md", "page.html"])
    with pytest.raises(OptionError, match="a file is where a folder is needed"):
        check_output(tmp_path / "notes.md", True, ["report.md"])

"""Test `check_output`: existing files are replaced only on request; links and folders are never replaced."""

from __future__ import annotations

import pytest

from icrl4aht_data.errors import OptionError
from icrl4aht_data.utils.files import check_output


def test_check_output_allows_replacing_files_only_on_request(tmp_path):
    path = tmp_path / "file.png"
    check_output(path, overwrite=False)
    path.write_bytes(b"")
    check_output(path, overwrite=True)
    with pytest.raises(OptionError, match=r"file\.png: exists; give another name, or use --overwrite to replace it"):
        check_output(path, overwrite=False)
    (tmp_path / "link.png").symlink_to(path)
    (tmp_path / "lost.png").symlink_to(tmp_path / "nothing")
    (tmp_path / "folder.png").mkdir()
    for name in ("link", "lost", "folder"):
        with pytest.raises(OptionError, match=f"{name}.png: expected a file, found a folder or a link"):
            check_output(tmp_path / f"{name}.png", overwrite=True)


def test_check_output_checks_the_named_files_of_a_folder(tmp_path):
    check_output(tmp_path / "new", False, ["report.md"])
    check_output(tmp_path, False, ["report.md"])
    (tmp_path / "notes.md").write_text("mine")
    with pytest.raises(OptionError, match="exists; give another folder, or use --overwrite to replace its files"):
        check_output(tmp_path, False, ["report.md"])
    (tmp_path / "report.md").write_text("old")
    check_output(tmp_path, True, ["report.md"])
    (tmp_path / "page.html").mkdir()
    with pytest.raises(OptionError, match=r"page\.html: expected a file, found a folder or a link"):
        check_output(tmp_path, True, ["report.md", "page.html"])
    with pytest.raises(OptionError, match="expected a folder, found a file"):
        check_output(tmp_path / "notes.md", True, ["report.md"])

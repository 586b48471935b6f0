"""Files that commands write: refused where something exists, replaced on demand where it has the form of our own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from PIL import Image

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.render import save_episode
from icrl4aht_data.plotting import save_figure
from icrl4aht_data.utils.new_file import check_new_file, check_new_files
from icrl4aht_data.writing.parquet import to_parquet


def write_gif(path: Path) -> None:
    dataset = load_icrl4aht(layout="demo_wide")
    save_episode(path, get_layout("demo_wide"), dataset[0].state[:2])


def write_index(path: Path) -> None:
    to_parquet(load_icrl4aht(layout="demo_wide"), path)


OURS: dict[str, Callable[[Path], object]] = {
    ".png": lambda path: save_figure(Figure(), path),
    ".svg": lambda path: save_figure(Figure(), path),
    ".pdf": lambda path: save_figure(Figure(), path),
    ".gif": write_gif,
    ".parquet": write_index,
}


@pytest.mark.parametrize("suffix", OURS)
def test_only_files_of_our_form_are_replaced(tmp_path, suffix):
    path = tmp_path / f"file{suffix}"
    for overwrite in (False, True):
        check_new_file(path, overwrite)
    OURS[suffix](path)
    check_new_file(path, overwrite=True)
    with pytest.raises(OptionError, match="exists; give another name, or replace it by --overwrite"):
        check_new_file(path, overwrite=False)
    for content in (b"", b"thesis", path.read_bytes()[1:]):
        path.write_bytes(content)
        with pytest.raises(OptionError, match="is not a file as this command writes it"):
            check_new_file(path, overwrite=True)


def test_pictures_and_tables_of_others_are_not_replaced(tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    Image.new("RGB", (2, 2)).save(tmp_path / "photo.png")
    Image.new("P", (2, 2)).save(tmp_path / "film.gif")
    for suffix in ("png", "svg", "pdf"):
        figure = Figure()
        figure.text(0, 0, "icrl4aht-data")
        figure.savefig(tmp_path / f"figure.{suffix}")
    pq.write_table(pa.table({"history_id": ["icrl4aht-data"]}), tmp_path / "other.parquet")
    (tmp_path / "page.html").write_text("<!doctype html>\n<title>mine</title>")
    for path in sorted(tmp_path.iterdir()):
        with pytest.raises(OptionError, match="is not a file as this command writes it"):
            check_new_file(path, overwrite=True)


def test_links_and_folders_are_not_replaced(tmp_path):
    write_gif(tmp_path / "real.gif")
    (tmp_path / "link.gif").symlink_to(tmp_path / "real.gif")
    (tmp_path / "lost.gif").symlink_to(tmp_path / "nothing")
    (tmp_path / "folder.gif").mkdir()
    for name, fault in {"link": "not a file as", "lost": "not a file as", "folder": "a folder is where"}.items():
        with pytest.raises(OptionError, match=fault):
            check_new_file(tmp_path / f"{name}.gif", overwrite=True)


def test_folders_of_files(tmp_path):
    begins = {"report.md": b"# Returns"}
    check_new_files(tmp_path / "new", False, begins)
    check_new_files(tmp_path, False, begins)
    (tmp_path / "notes.md").write_text("mine")
    with pytest.raises(OptionError, match="exists; give another folder, or replace its files by --overwrite"):
        check_new_files(tmp_path, False, begins)
    check_new_files(tmp_path, True, begins)
    (tmp_path / "report.md").write_text("# Returns of bonds")
    check_new_files(tmp_path, True, begins)
    (tmp_path / "report.md").write_text("mine")
    with pytest.raises(OptionError, match=r"report\.md: is not a file as"):
        check_new_files(tmp_path, True, begins)
    with pytest.raises(OptionError, match="a file is where a folder is needed"):
        check_new_files(tmp_path / "notes.md", True, begins)

"""Commands that install extras name the source of this installation: a checkout, a wheel, a repository or an index."""

from __future__ import annotations

import json
import shlex
from importlib.metadata import PackageNotFoundError, PathDistribution
from pathlib import Path

import pytest

from icrl4aht_data.utils import installation
from icrl4aht_data.utils.installation import (
    install_command,
    installation_source,
    restore_command,
    upgrade_advice,
)
from tests.helpers.paths import ROOT

METADATA = """Metadata-Version: 2.4
Name: icrl4aht-data
Version: 9
Provides-Extra: plot
Provides-Extra: hf
Requires-Dist: numpy>=2
Requires-Dist: tomli>=2; python_version < '3.0'
Requires-Dist: matplotlib>=3.9; extra == 'plot'
Requires-Dist: pillow>=10.3; extra == 'plot'
Requires-Dist: datasets[s3]>=4; extra == 'hf'
"""


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install metadata with this direct_url.json, as the installer would write them."""

    def install(about: dict | None, installer: str = "pip") -> None:
        folder = tmp_path / "icrl4aht_data-9.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(METADATA)
        (folder / "INSTALLER").write_text(f"{installer}\n")
        if about is not None:
            (folder / "direct_url.json").write_text(json.dumps(about))
        monkeypatch.setattr(installation, "distribution", lambda name: PathDistribution(folder))

    return install


def test_index(installed):
    installed(None)
    assert install_command("plot") == "pip install 'icrl4aht-data[plot]'"
    assert install_command("plot", "hf") == "pip install 'icrl4aht-data[plot,hf]'"
    assert install_command() == "pip install icrl4aht-data"
    assert upgrade_advice() == "`pip install -U icrl4aht-data`"
    assert restore_command() == "pip install --force-reinstall --no-deps icrl4aht-data"
    assert str(installation_source()) == "package index"


def test_editable_checkout(installed, tmp_path):
    folder = tmp_path / "my checkout"
    installed({"url": folder.as_uri(), "dir_info": {"editable": True}})
    assert shlex.split(install_command("plot")) == ["pip", "install", "--editable", f"{folder}[plot]"]
    assert upgrade_advice() == f"update the checkout {folder}"
    assert shlex.split(restore_command()) == ["git", "-C", str(folder), "checkout", "icrl4aht_data"]
    assert str(installation_source()) == f"editable checkout {folder}"


@pytest.mark.parametrize("about", [{"archive_info": {}}, {"dir_info": {}}, {"dir_info": {"editable": False}}])
def test_local_wheel_or_folder(installed, tmp_path, about):
    source = tmp_path / "icrl4aht_data-9-py3-none-any.whl"
    source.touch()
    installed({"url": source.as_uri(), **about})
    assert install_command("hf") == f"pip install 'icrl4aht-data[hf] @ {source.as_uri()}'"
    assert restore_command() == f"pip install --force-reinstall --no-deps 'icrl4aht-data @ {source.as_uri()}'"
    assert source.as_uri() in upgrade_advice()
    source.unlink()
    assert install_command("plot") == "pip install 'matplotlib>=3.9' 'pillow>=10.3'", "the wheel is gone"
    assert install_command("plot", "hf") == "pip install 'datasets[s3]>=4' 'matplotlib>=3.9' 'pillow>=10.3'"


@pytest.mark.parametrize(
    ("about", "address"),
    [
        ({"url": "https://example.org/a.whl", "archive_info": {}}, "https://example.org/a.whl"),
        (
            {"url": "https://example.org/r.git", "vcs_info": {"vcs": "git", "commit_id": "abc"}, "subdirectory": "py"},
            "git+https://example.org/r.git@abc#subdirectory=py",
        ),
    ],
)
def test_remote_archive_or_repository(installed, about, address):
    installed(about)
    assert install_command("plot") == f"pip install 'icrl4aht-data[plot] @ {address}'"
    assert str(installation_source()) == address


def test_uv_is_named_where_it_installed_this_package(installed):
    installed(None, installer="uv")
    assert install_command("plot") == "uv pip install 'icrl4aht-data[plot]'"


def test_copy_that_is_not_installed(monkeypatch, tmp_path):
    def missing(name: str) -> None:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(installation, "distribution", missing)
    assert shlex.split(install_command("plot")) == ["pip", "install", "--editable", f"{ROOT}[plot]"]
    monkeypatch.setattr(installation, "_CHECKOUT", Path(tmp_path))
    assert install_command("plot") == "pip install 'icrl4aht-data[plot]'"

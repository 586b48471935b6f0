"""The source of this installation, and commands that install extras from the same source.

pip and uv note where a package came from in the file direct_url.json of its metadata (PEP 610); a package from an index
has no such file. Messages about a missing library therefore name a command that works for this copy: a checkout, a
wheel, a repository or an index.
"""

from __future__ import annotations

import json
import shlex
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit
from urllib.request import url2pathname

from packaging.requirements import Requirement

PACKAGE = "icrl4aht-data"
"""Name of the distribution, which contains the packages icrl4aht_data, generation and baselines."""

_CHECKOUT = Path(__file__).parents[2]


class InstallationSource(NamedTuple):
    """Where this package was installed from.

    Attributes:
        checkout: the folder of an editable installation; None for any other.
        url: address of a wheel, folder, archive or repository, as pip takes it; None for an index.
        installer: the command that installs packages into this environment.
    """

    checkout: Path | None
    url: str | None
    installer: str = "pip install"

    def __str__(self) -> str:
        if self.checkout is not None:
            return f"editable checkout {self.checkout}"
        return self.url or "package index"


def installation_source() -> InstallationSource:
    """Return where this package was installed from; a copy that is not installed is a checkout on Python's path."""
    try:
        found = distribution(PACKAGE)
    except PackageNotFoundError:
        return InstallationSource(_CHECKOUT if (_CHECKOUT / "pyproject.toml").is_file() else None, None)
    installer = "uv pip install" if (found.read_text("INSTALLER") or "").strip() == "uv" else "pip install"
    noted = found.read_text("direct_url.json")
    if noted is None:
        return InstallationSource(None, None, installer)
    about = json.loads(noted)
    url = about["url"]
    if about.get("dir_info", {}).get("editable"):
        return InstallationSource(_path(url), None, installer)
    if version_control := about.get("vcs_info"):
        url = f"{version_control['vcs']}+{url}@{version_control['commit_id']}"
    if folder := about.get("subdirectory"):
        url += f"#subdirectory={folder}"
    return InstallationSource(None, url, installer)


def install_command(*extras: str, options: str = "") -> str:
    """Return the shell command that installs this package again, with extras, from where this copy came from.

    Where a local wheel or folder no longer exists, the command names the requirements of the extras instead.

    Args:
        extras: names of extras, such as "plot"; none for the package alone.
        options: further options of the installer, such as "--no-deps".
    """
    source, chosen = installation_source(), f"[{','.join(extras)}]" if extras else ""
    command = f"{source.installer} {options}".strip()
    if source.checkout is not None:
        return f"{command} --editable {shlex.quote(f'{source.checkout}{chosen}')}"
    if source.url is None:
        return f"{command} {shlex.quote(PACKAGE + chosen)}"
    if extras and source.url.startswith("file:") and not _path(source.url).exists():
        return f"{command} {shlex.join(_requirements(distribution(PACKAGE), extras))}"
    return f"{command} {shlex.quote(f'{PACKAGE}{chosen} @ {source.url}')}"


def upgrade_advice() -> str:
    """Return how to get a newer version of this package."""
    source = installation_source()
    if source.checkout is not None:
        return f"update the checkout {source.checkout}"
    if source.url is not None:
        return f"install a newer version; this one came from {source.url}"
    return f"`{source.installer} -U {PACKAGE}`"


def restore_command(package: str = "icrl4aht_data") -> str:
    """Return the shell command that restores the files of a package: this one, generation or baselines."""
    checkout = installation_source().checkout
    if checkout is not None:
        return f"git -C {shlex.quote(str(checkout))} checkout {package}"
    return install_command(options="--force-reinstall --no-deps")


def _path(url: str) -> Path:
    return Path(url2pathname(urlsplit(url).path))


def _requirements(found: Distribution, extras: tuple[str, ...]) -> list[str]:
    """Return the requirements that only the extras have, without their markers."""
    listed = [Requirement(line) for line in found.requires or []]
    wanted = [
        one
        for one in listed
        if one.marker
        and not one.marker.evaluate({"extra": ""})
        and any(one.marker.evaluate({"extra": extra}) for extra in extras)
    ]
    return sorted({str(one).partition(";")[0].strip() for one in wanted})

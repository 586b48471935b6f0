"""Hostile servers: what a remote release may answer, and what must come of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from icrl4aht_data.format.schema import HISTORIES, INFO, MANIFEST, TASKS
from icrl4aht_data.remote import store as transport
from icrl4aht_data.remote.download import fetch_planned, plan_download
from tests.helpers.random_play import SHARD
from tests.robustness.hostile_folders import TABLE, listed, sparse
from tests.servers.common import Faults, IgnoreRange, Long, Redirect, http_server

ENDLESS = 2**40


def download(url: str, out: Path) -> None:
    """All of a release, by one try of each request."""
    fetch_planned(plan_download(url, to=out / "mirror", retry=transport.RetryPolicy(2, 0.01)))


def _served(spoil: Callable[[Path], object] | None = None, *rules: Any) -> Callable[[Path, Path], Any]:
    """A release, spoiled, behind a server that does what the rules say."""

    def step(root: Path, out: Path) -> None:
        if spoil is not None:
            spoil(root)
        faults = Faults()
        for path, fault in rules:
            faults.every(1, fault, path=path, method=None)
        with http_server(root, faults) as server:
            download(server.url, out)

    return step


def _terabyte(name: str) -> Callable[[Path], object]:
    return lambda root: sparse(root / name, root)


SERVED: dict[str, tuple[Callable[[Path, Path], Any], str]] = {
    "endless manifest": (_served(None, ("*/MANIFEST.sha256", Long(ENDLESS))), "MANIFEST"),
    "endless index": (_served(None, (f"*/{HISTORIES}", Long(ENDLESS))), "expected at most|more came|says"),
    "endless shard": (_served(None, ("*.h5", Long(ENDLESS))), "more came"),
    "no ranges, and no end": (_served(_terabyte(SHARD), ("*.h5", IgnoreRange())), "more came"),
    "a terabyte for a manifest": (_served(_terabyte(MANIFEST)), "expected at most"),
    "a terabyte for a text": (_served(_terabyte(TASKS)), "expected at most"),
    "a terabyte for a chunk table": (_served(_terabyte(TABLE)), "expected at most"),
    "a terabyte for a shard": (_served(_terabyte(SHARD)), "sha256|cover|crc32"),
    "to a file of this machine": (_served(None, (f"*/{INFO}", Redirect("file:///etc/passwd"))), "info.json"),
    "to another protocol": (_served(None, ("*.h5", Redirect("ftp://127.0.0.1/x"))), "h5"),
    "in a circle": (_served(None, (f"*/{INFO}", Redirect(f"/{INFO}"))), "info.json"),
    "names above": (_served(listed("../../new")), "leads out of the release"),
    "names that collide": (_served(listed("readme.md")), "one file on some systems"),
    "a file that is a folder": (_served(listed("README.md/x")), "is a file by another line"),
}

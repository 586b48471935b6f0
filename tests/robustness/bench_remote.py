"""Requests, bytes and seconds of remote releases over HTTP, S3 and the Hub's protocol: `make bench-remote`.

    stream      one AD batch without downloading: requests per window, share of the bytes of the layout's shards
    download    one layout of two, then verify every byte of it
    repair      after flipped bits: share of the shard that is fetched again

All servers are on loopback. One JSON line for each kind of remote. Exits with 1 if a target is missed or data differ
from the local release.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.harness import print_line
from benchmarks.histories import write_many
from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.commands.options import COUNT
from icrl4aht_data.format.chunks import chunk_table_path
from icrl4aht_data.remote.download import fetch_planned, plan_download, repair
from tests.servers.common import http_server, hub_server, s3_server

LAYOUTS = ("coord_simple", "demo_wide")
REMOTES = ("http", "s3", "hub")
TARGETS = {"requests_a_window": 1.5, "streamed_share": 0.03, "repaired_share": 0.01}


@contextmanager
def remote(kind: str, folder: Path) -> Iterator[str]:
    """Address of a release on a server of a kind."""
    if kind == "http":
        with http_server(folder) as server:
            yield server.url
    elif kind == "s3":
        with s3_server(folder) as server:
            yield server.url
    else:
        with tempfile.TemporaryDirectory() as root, hub_server(Path(root)) as hub:
            hub.add_repo("org/histories", folder, tag="v0.0.0")
            yield "hf://datasets/org/histories@v0.0.0"


def measure(url: str, local: Path, windows: int, length: int) -> dict[str, Any]:
    """Stream, download, flip bits and repair; figures by name."""
    facts: dict[str, Any] = {}
    dataset = load_icrl4aht(url, obs="state", layout=LAYOUTS[0])
    _ = dataset.storage  # fetches the chunk table, which is metadata
    facts["metadata_bytes"] = dataset.traffic.bytes
    before, began = dataset.traffic, time.perf_counter()
    batch = dataset.ad(batch_size=windows, length=length, seed=0)[0]
    traffic = dataset.traffic - before
    facts["stream_seconds"] = round(time.perf_counter() - began, 3)
    expected = load_icrl4aht(local, obs="state", layout=LAYOUTS[0]).ad(batch_size=windows, length=length, seed=0)[0]
    pairs = [(a, b) for a, b in zip(batch, expected, strict=True) if a is not None and b is not None]
    facts["equal"] = all(np.array_equal(a, b) for a, b in pairs)
    facts["requests"], facts["bytes"] = traffic.requests, traffic.bytes
    facts["requests_a_window"] = round(traffic.requests / windows, 3)
    facts["streamed_share"] = round(traffic.bytes / sum(dataset.info.shards[name] for name in dataset.shards), 4)

    began = time.perf_counter()
    plan = plan_download(url, layout=LAYOUTS[1])
    fetch_planned(plan)
    facts["download_bytes"], facts["download_seconds"] = plan.size, round(time.perf_counter() - began, 3)
    facts["complete"] = verify_release(url, layout=LAYOUTS[1]).ok

    name = load_icrl4aht(url, layout=LAYOUTS[1]).shards[0]
    root = plan.root.folder
    path, table = (root / name).resolve(), np.load(chunk_table_path(root, name))
    intact = path.read_bytes()
    damaged = bytearray(intact)
    for row in (len(table) // 3, len(table) - 1):  # in a chunk, and between the chunks
        damaged[int(table["offset"][row]) + 5] ^= 16
    path.write_bytes(damaged)
    outcome, traffic = repair(url, [name])
    facts["repaired"] = outcome == {name: None} and path.read_bytes() == intact
    facts["repaired_share"] = round(traffic.bytes / len(intact), 5)
    return facts


@click.command()
@click.option("--folder", type=click.Path(path_type=Path), default=Path("build/bench-remote"), show_default=True)
@click.option("--histories", type=COUNT, default=320, show_default=True, help="Histories of each of two layouts.")
@click.option("--windows", type=COUNT, default=64, show_default=True)
@click.option("--length", type=COUNT, default=500, show_default=True)
@click.option("--remote", "kinds", multiple=True, type=click.Choice(REMOTES), default=REMOTES, show_default=True)
def main(folder: Path, histories: int, windows: int, length: int, kinds: tuple[str, ...]) -> None:
    """Measure requests, bytes and seconds of remote releases; one JSON line for each kind."""
    shutil.rmtree(folder, ignore_errors=True)
    release = write_many(folder / "release", LAYOUTS, histories)
    missed: list[str] = []
    for kind in kinds:
        os.environ["ICRL4AHT_DATA_DIR"] = str((folder / kind).resolve())
        with remote(kind, release) as url:
            facts = measure(url, release, windows, length)
        wrong = [name for name, most in TARGETS.items() if facts[name] > most]
        wrong += [name for name in ("equal", "complete", "repaired") if not facts[name]]
        print_line("remote", remote=kind, **facts, targets=TARGETS, missed=wrong)
        missed += wrong
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()

"""Faults, and what survives them: `make bench-faults`.

Servers on loopback, disks, processes and files do what they should not. A try survives if what comes out is right byte
for byte; or, where that cannot be, if an error of ours names the file, nothing half written has a file's name, and a
second call, when the fault is over, succeeds without fetching what had come. All else is lost. One JSON line a family;
why something was lost goes to the standard error. Exit code 1 if anything was.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import click

from tests.robustness.faults import here, remote
from tests.robustness.faults.scene import Scene, Try

Family = Callable[[Scene, int], Iterator[Try]]

FAMILIES: dict[str, tuple[Family, int]] = {
    "connection cut": (remote.cuts, 50),
    "429 with Retry-After": (remote.too_many, 6),
    "bursts of 5xx": (remote.busy, 24),
    "slow server": (remote.slow, 8),
    "wrong length": (remote.lengths, 24),
    "wrong bytes": (remote.flips, 24),
    "wrong manifest": (remote.manifests, 24),
    "ETag changed": (remote.etags, 6),
    "version changed": (remote.versions, 10),
    "ranges ignored": (remote.no_ranges, 4),
    "disk full": (here.full_disk, 16),
    "cache's disk full": (here.full_cache, 8),
    "download killed": (here.killed_downloads, 10),
    "cache build killed": (here.killed_builds, 10),
    "two downloads at once": (here.two_processes, 5),
    "two readers at once": (here.two_readers, 5),
    "bit flips": (here.bit_flips, 1000),
    "mutated index or manifest": (here.mutations, 200),
    "hub: connection cut": (partial(remote.cuts, place=remote.on_hub), 12),
    "hub: bursts of 5xx": (partial(remote.busy, place=remote.on_hub), 9),
    "hub: wrong bytes": (partial(remote.flips, place=remote.on_hub), 12),
    "hub: wrong manifest": (partial(remote.manifests, place=remote.on_hub), 12),
    "s3: connection cut": (partial(remote.cuts, place=remote.on_s3), 6),
    "s3: bursts of 5xx": (partial(remote.busy, place=remote.on_s3), 4),
    "s3: wrong bytes": (partial(remote.flips, place=remote.on_s3), 6),
}
"""Name -> family, and how often it is tried."""


def run(name: str, family: Family, scene: Scene, count: int) -> dict[str, Any]:
    """One family's line; beside the counts whatever its tries found odd, though nothing was lost."""
    began, survived, odd = time.perf_counter(), [], Counter()
    for attempt in family(scene, count):
        survived.append(False)
        try:
            said = attempt()
            survived[-1] = True
            odd.update([said] if said else [])
        except Exception:  # whatever it is, it is no error that a user should see
            click.echo(f"{name}, try {len(survived)}:\n{traceback.format_exc()}", err=True)
    tried, kept = len(survived), sum(survived)
    seconds = round(time.perf_counter() - began, 1)
    return {"fault": name, "tried": tried, "survived": kept, "lost": tried - kept, **odd, "seconds": seconds}


@click.command()
@click.argument("names", nargs=-1, type=click.Choice(list(FAMILIES)))
@click.option("--scale", default=1.0, show_default=True, help="How often each fault is tried.")
@click.option("--seed", default=0, show_default=True, help="Of the random moments, places and bits.")
def main(names: tuple[str, ...], scale: float, seed: int) -> None:
    """Try faults (all by default) and count what is lost."""
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        scene = Scene(Path(folder), seed)
        for name in names or FAMILIES:
            family, count = FAMILIES[name]
            lines.append(run(name, family, scene, max(1, round(scale * count))))
            click.echo(json.dumps(lines[-1]))
    total = {key: round(sum(line[key] for line in lines), 1) for key in ("tried", "survived", "lost", "seconds")}
    click.echo(json.dumps({"fault": "total", **total}))
    sys.exit(int(total["lost"] > 0))


if __name__ == "__main__":
    main()

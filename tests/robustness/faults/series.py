"""Series of faults: `make bench-faults`.

Disks, processes and files fail at random moments. An attempt survives if the result is right byte for byte; or, where
that is impossible, if one of our errors names the file, no incomplete file has the name of a file of the release, and a
second call after the fault succeeds. Everything else counts as lost. Prints one JSON line a family; the reason of each
loss goes to standard error. Exit code 1 if anything was lost.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click

from tests.robustness.faults import local
from tests.robustness.faults.workspace import Attempt, Workspace

Family = Callable[[Workspace, int], Iterator[Attempt]]
"""Yields n attempts."""

FAMILIES: dict[str, tuple[Family, int]] = {
    "disk full": (local.full_disk, 20),
    "cache build killed": (local.killed_builds, 10),
    "two downloads at once": (local.two_downloads, 5),
    "two readers at once": (local.two_readers, 5),
    "two cache builds at once": (local.two_builds, 5),
    "mapped arrays' disk full": (local.full_mmap, 20),
    "damaged caches": (local.damaged_caches, 100),
    "bit flips": (local.bit_flips, 1000),
    "mutated index or manifest": (local.mutations, 200),
}
"""Name -> family, and the number of its attempts."""


def run(name: str, family: Family, workspace: Workspace, count: int) -> dict[str, Any]:
    """Return the JSON line of a family: counts of attempts and of their remarks, and seconds."""
    began, survived, remarks = time.perf_counter(), [], Counter()
    for attempt in family(workspace, count):
        survived.append(False)
        try:
            remark = attempt()
            survived[-1] = True
            remarks.update([remark] if remark else [])
        except Exception:  # any other exception is one that a user should not see
            click.echo(f"{name}, attempt {len(survived)}:\n{traceback.format_exc()}", err=True)
    tried, kept = len(survived), sum(survived)
    seconds = round(time.perf_counter() - began, 1)
    return {"fault": name, "tried": tried, "survived": kept, "lost": tried - kept, **remarks, "seconds": seconds}


@click.command()
@click.argument("names", nargs=-1, type=click.Choice(list(FAMILIES)))
@click.option("--scale", default=1.0, show_default=True, help="Factor of the numbers of attempts.")
@click.option("--seed", default=0, show_default=True, help="Seed of the random moments, positions and bits.")
def main(names: tuple[str, ...], scale: float, seed: int) -> None:
    """Inject faults (all families by default) and count what is lost."""
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        workspace = Workspace(Path(folder), seed)
        for name in names or FAMILIES:
            family, count = FAMILIES[name]
            lines.append(run(name, family, workspace, max(1, round(scale * count))))
            click.echo(json.dumps(lines[-1]))
    total = {key: round(sum(line[key] for line in lines), 1) for key in ("tried", "survived", "lost", "seconds")}
    click.echo(json.dumps({"fault": "total", **total}))
    sys.exit(int(total["lost"] > 0))


if __name__ == "__main__":
    main()

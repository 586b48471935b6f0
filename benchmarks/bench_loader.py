"""Windows/s with every cache compared with two readers of the published format: `make bench-loader`.

All read the same histories (bundled ones, rotated by complete episodes) and make the same windows:

    published   h5py, float32 gzip-6, chunks of 4096, slices merged per history, 512 MB chunk cache, one thread
    fair        the same data in chunks of 500, read_direct into a preallocated batch
    ours        ram, mmap, stream (with and without decoded chunks kept); states, uint8, float32; batch buffers reused

Readers take turns, round by round. One JSON line for each of our readers, with the ratio to both peers and our target
ratio. Part `index` measures opening an index of a million histories, in separate processes.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.harness import compared, elapsed, print_line
from benchmarks.published import fair_reader, published_reader
from icrl4aht_data import ADBatch, ADSampler, Dataset, load_icrl4aht
from icrl4aht_data.benchmark.tasks import read_tasks
from icrl4aht_data.commands.options import COUNT
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import TASKS, held_fields
from icrl4aht_data.writing.published import to_published
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release

_AIMS = {("ram", "state"): 8000, ("ram", "uint8"): 400, ("ram", "float32"): 200}
"""(cache, observations) -> target ratio to the published reader."""

CACHES = ("ram", "mmap", "stream", "stream, nothing kept")
REPEATS = {"state": 10, "uint8": 3, "float32": 3}
"""Form of observations -> batches per round, of which the median is reported."""

_print = partial(print_line, "loader")


def make_data(folder: Path, layout: str, histories: int) -> None:
    """Write the histories as lite, published and fair files, unless they exist."""
    if (folder / "done").exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    source = load_icrl4aht(split="train", source="ppo", layout=layout)
    task = next(task for task in read_tasks(source.root / TASKS) if task.layout.name == layout)
    new = NewTask(task, Provenance(), histories, partial(rotated_histories, source, histories))
    write_release(folder / "lite", "lite", [new], data_version="0.0.0", card="# benchmark\n")
    dataset = load_icrl4aht(folder / "lite")
    to_published(dataset, folder / "published", states=False)
    to_published(dataset, folder / "fair", chunk=500, states=False)
    (folder / "done").touch()


def rotated_histories(source: Dataset, count: int) -> Iterator[NewHistory]:
    """Yield a selection's histories endlessly, rotated by one more episode in each round."""
    kept = source.info.environment.kept_steps
    for number in range(count):
        history, episodes = source[number % len(source)], number // len(source)
        arrays = {
            field.name: np.roll(history.read(field.name), episodes * (kept if field.axis == "T" else 1), axis=0)
            for field in held_fields("lite")
            if history.entry.has(field)
        }
        yield NewHistory(number, arrays)


def batch_seconds(sampler: ADSampler, buffer: ADBatch | None, cache: str, first: int) -> float:
    """Return the median seconds per batch, from batch `first` on."""
    sampler.batch(10**6, buffer)  # warm-up: decodes chunks, and maps the buffer's pages
    taken = []
    for i in range(first, first + REPEATS[sampler.dataset.obs]):
        if cache == "stream, nothing kept":
            sampler.dataset.forget_chunks()
        taken.append(elapsed(lambda i=i: sampler.batch(i, buffer)))
    return statistics.median(taken)


def compare_readers(folder: Path, batch: int, length: int, rounds: int, threads: int, peer_windows: int) -> None:
    """Measure our samplers with every cache mode and form of observations, and both peers."""
    dataset: Any = load_icrl4aht(folder / "lite", threads=threads)
    windows_of = dataset.ad(batch_size=batch, length=length, seed=1).windows
    peers = {
        "published": published_reader(folder / "published", length),
        "fair": fair_reader(folder / "fair", length, peer_windows),
    }
    samplers = {
        (cache, obs): dataset.with_options(cache=cache.split(",")[0], obs=obs).ad(
            batch_size=batch, length=length, seed=1
        )
        for obs in REPEATS
        for cache in CACHES[: 4 if obs == "state" else 3]
    }
    rates: dict[Any, list[float]] = {name: [] for name in (*peers, *samplers)}
    for number in range(rounds):
        windows = [drawn[:peer_windows] for drawn in windows_of(number)]
        for name, read in peers.items():
            rates[name].append(peer_windows / elapsed(partial(read, *windows)))
        held, buffer = "", None
        for (cache, obs), sampler in samplers.items():
            if obs != held:
                buffer = None  # one buffer at a time, since a float32 batch is large
                held, buffer = obs, sampler.empty()
            rates[cache, obs].append(batch / batch_seconds(sampler, buffer, cache, 1000 * number + 1))
    for (cache, obs), peer in product(samplers, peers):
        aim = {"least_ratio": _AIMS.get((cache, obs))} if peer == "published" else {}
        _print(part="read", cache=cache, obs=obs, peer=peer, **compared(rates, (cache, obs), peer), **aim)


_OPEN_INDEX = """
import json, resource, sys, time
from pathlib import Path
from icrl4aht_data.format.index import read_index
started = time.perf_counter()
index = read_index(Path(sys.argv[1]))
opened = time.perf_counter()
first = index.entry(0)
index.query(layout=first.layout, teammate_family=first.teammate_family)
seconds = {"open_seconds": opened - started, "query_seconds": time.perf_counter() - opened}
print(json.dumps(seconds | {"peak_megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024}))
"""


def index_times(folder: Path, lines: int) -> None:
    """Print the times to open a long index in separate processes, first with an empty cache folder."""
    root = folder / f"index-{lines}"
    if not (root / "meta" / "info.json").exists():
        write_long_index(root, lines)
    with_cache = os.environ | {"ICRL4AHT_CACHE_DIR": str(folder / "index-cache")}
    shutil.rmtree(folder / "index-cache", ignore_errors=True)
    for opening, most in (("first", 10), ("second", 0.05), ("third", 0.05)):
        run = subprocess.run(
            [sys.executable, "-c", _OPEN_INDEX, str(root)], env=with_cache, capture_output=True, text=True, check=True
        )
        _print(part="index", opening=opening, lines=lines, target_open_seconds=most, **json.loads(run.stdout))


def write_long_index(root: Path, lines: int) -> None:
    """Write an index of many tasks of 128 histories, with entries of the bundled release."""
    source = load_icrl4aht()
    rng = np.random.default_rng(0)
    (root / "meta").mkdir(parents=True, exist_ok=True)
    entries = [entry.to_json() for entry in source.entries]
    scores = ("score", "return_start", "return_end", "return_mean")
    with (root / "meta" / "histories.jsonl").open("w") as stream:
        for number in range(lines):
            task = number // 128
            line = entries[7 * task % len(entries)]
            name, _, ending = line["shard"].rpartition("/")
            line = line | {
                "history_id": number,
                "env_idx": int(rng.integers(1024)),
                "h5_row": number % 1024,
                "task_id": f"{line['task_id']}_{task:06}",
                "shard": f"{name}/{ending.split('-')[0]}-{number // 1024:05}-of-{lines // 1024 + 1:05}.h5",
                **dict(zip(scores, rng.normal(30, 10, 4).tolist(), strict=True)),
            }
            stream.write(json.dumps(line) + "\n")
    info = source.info.to_json() | {"histories": lines}
    (root / "meta" / "info.json").write_text(json.dumps(info))


@click.command()
@click.option("--folder", type=click.Path(path_type=Path), default=Path("build/bench-loader"), show_default=True)
@click.option("--part", "parts", multiple=True, type=click.Choice(["read", "index"]), default=("read", "index"))
@click.option("--layout", default="coord_simple", show_default=True)
@click.option("--histories", type=COUNT, default=128, show_default=True)
@click.option("--batch", type=COUNT, default=1024, show_default=True)
@click.option("--length", type=COUNT, default=500, show_default=True)
@click.option("--rounds", type=COUNT, default=3, show_default=True)
@click.option("--threads", type=COUNT, default=2, show_default=True)
@click.option("--peer-windows", type=COUNT, help="Windows that the peers read in a round.", show_default="a batch")
@click.option("--lines", type=COUNT, default=1_000_000, show_default=True, help="Lines of the long index.")
def main(
    folder: Path, parts: tuple[str, ...], layout: str, histories: int, lines: int, peer_windows: int | None, **read: int
) -> None:
    """Compare our loader with two readers of the published format, and open a long index; one JSON line each."""
    os.environ.setdefault("ICRL4AHT_CACHE_DIR", str(folder.resolve() / "cache"))
    if "read" in parts:
        make_data(folder, layout, histories)
        compare_readers(folder, **read, peer_windows=peer_windows or read["batch"])
    if "index" in parts:
        index_times(folder, lines)


if __name__ == "__main__":
    main()

"""Compare the loader's windows/s with those of two readers of the published format: `make bench-loader`.

All readers make the same windows of the same histories, which are bundled histories rotated by complete episodes:

    published:  one thread reads float32 data, compressed by gzip level 6 in chunks of 4096 steps, with h5py; it merges
                the slices of a history, and has a chunk cache of 512 MB
    fair:       h5py reads the same data in chunks of 500 steps directly into a preallocated batch
    ours:       reads state records, or uint8 or float32 observations, with each cache (ram, mmap, and stream with and
                without decoded chunks in memory), into reused batch buffers

Readers take turns in rounds. One JSON line is printed for each of our readers and each peer, with their ratio and
our target ratio to the reader `published`.
"""

from __future__ import annotations

import os
import shutil
import statistics
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np

from benchmarks.harness import compare_rates, elapsed, print_line
from icrl4aht_data import ADBatch, ADSampler, Dataset, load_icrl4aht
from icrl4aht_data.benchmark.tasks import read_tasks
from icrl4aht_data.commands.options import COUNT
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.format.schema import TASKS, memory_fields
from icrl4aht_data.writing.published import HISTORIES_H5, to_published
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release

_AIMS = {("ram", "state"): 8000, ("ram", "uint8"): 400, ("ram", "float32"): 200}
"""(cache, observations) -> target ratio to the published reader."""

CACHES = ("ram", "mmap", "stream", "stream, nothing kept")
REPEATS = {"state": 10, "uint8": 3, "float32": 3}
"""Form of observations -> number of batches per round, whose median time is used."""


_READ = ("obs", "actions", "rewards", "dones")

ReadWindows = Callable[[np.ndarray, np.ndarray], dict[str, np.ndarray]]
"""Function from (histories int (B,), starts int (B,)) to field -> windows (B, L, ...)."""


def published_reader(folder: Path, length: int) -> ReadWindows:
    """Return a reader like the published code's: overlapping or adjacent windows are read as one slice, then split."""
    file = h5py.File(folder / HISTORIES_H5, "r", rdcc_nbytes=512 * 2**20)

    def read(ids: np.ndarray, starts: np.ndarray) -> dict[str, np.ndarray]:
        windows: dict[str, list] = {name: [None] * len(ids) for name in _READ}
        for history in np.unique(ids):
            rows = np.flatnonzero(ids == history)
            rows = rows[np.argsort(starts[rows])]
            begin = starts[rows].tolist()
            k = 0
            while k < len(rows):
                last = k
                while last + 1 < len(rows) and begin[last + 1] <= begin[last] + length:
                    last += 1
                for name in windows:
                    dataset: Any = file[f"/{history}/{name}"]
                    block = dataset[begin[k] : begin[last] + length]
                    for j in range(k, last + 1):
                        windows[name][rows[j]] = block[begin[j] - begin[k] : begin[j] - begin[k] + length]
                k = last + 1
        return {name: np.stack(parts) for name, parts in windows.items()}

    return read


def fair_reader(folder: Path, length: int, batch: int) -> ReadWindows:
    """Return a reader that uses h5py in a way that suits random windows, for a fair comparison with our loader.

    Unlike the published reader, it reads each window directly into a reused buffer, from files with shorter chunks.
    """
    file = h5py.File(folder / HISTORIES_H5, "r")
    first: Any = {name: file[f"/0/{name}"] for name in _READ}
    out = {name: np.ones((batch, length, *data.shape[1:]), data.dtype) for name, data in first.items()}

    def read(ids: np.ndarray, starts: np.ndarray) -> dict[str, np.ndarray]:
        for row, (history, start) in enumerate(zip(ids.tolist(), starts.tolist(), strict=True)):
            for name, array in out.items():
                dataset: Any = file[f"/{history}/{name}"]
                dataset.read_direct(array, np.s_[start : start + length], np.s_[row])
        return out

    return read


def make_data(folder: Path, layout: str, histories: int) -> None:
    """Write the data of all three readers, if not yet done: a release for our loader, files for both others."""
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
    """Yield `count` histories by cycling through `source`, rotated by one more episode in each cycle."""
    kept = source.info.environment.kept_steps
    for number in range(count):
        history, episodes = source[number % len(source)], number // len(source)
        arrays = {
            field.name: np.roll(history.read(field.name), episodes * (kept if field.axis == "T" else 1), axis=0)
            for field in memory_fields("lite")
            if history.entry.has(field)
        }
        yield NewHistory(number, arrays)


def batch_seconds(sampler: ADSampler, buffer: ADBatch | None, cache: str, first: int) -> float:
    """Return the median seconds per batch, for batches from number `first` on."""
    sampler.batch(10**6, buffer)  # warm-up, which decodes chunks and touches the buffer's memory
    taken = []
    for i in range(first, first + REPEATS[sampler.dataset.obs]):
        if cache == "stream, nothing kept":
            sampler.dataset.clear_chunk_cache()
        taken.append(elapsed(lambda i=i: sampler.batch(i, buffer)))
    return statistics.median(taken)


def compare_readers(folder: Path, batch: int, length: int, rounds: int, threads: int, peer_windows: int) -> None:
    """Compare the windows per second of our sampler with those of `published_reader` and `fair_reader`.

    Our sampler is measured with each combination of cache mode and observation type.
    """
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
                buffer = None  # only one buffer at a time is kept, since float32 batches are large
                held, buffer = obs, sampler.empty()
            rates[cache, obs].append(batch / batch_seconds(sampler, buffer, cache, 1000 * number + 1))
    for (cache, obs), peer in product(samplers, peers):
        aim = {"least_ratio": _AIMS.get((cache, obs))} if peer == "published" else {}
        print_line(
            "loader", part="read", cache=cache, obs=obs, peer=peer, **compare_rates(rates, (cache, obs), peer), **aim
        )


@click.command()
@click.option("--folder", type=click.Path(path_type=Path), default=Path("build/bench-loader"), show_default=True)
@click.option("--layout", default="coord_simple", show_default=True)
@click.option("--histories", type=COUNT, default=128, show_default=True)
@click.option("--batch", type=COUNT, default=1024, show_default=True)
@click.option("--length", type=COUNT, default=500, show_default=True)
@click.option("--rounds", type=COUNT, default=3, show_default=True)
@click.option("--threads", type=COUNT, default=2, show_default=True)
@click.option("--peer-windows", type=COUNT, help="Windows that the peers read in a round.", show_default="a batch")
def main(folder: Path, layout: str, histories: int, peer_windows: int | None, **read: int) -> None:
    """Compare our loader with two readers of the published format; print one JSON line per comparison."""
    os.environ.setdefault("ICRL4AHT_CACHE_DIR", str(folder.resolve() / "cache"))
    make_data(folder, layout, histories)
    compare_readers(folder, **read, peer_windows=peer_windows or read["batch"])


if __name__ == "__main__":
    main()

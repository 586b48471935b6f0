"""Batches/s with every cache compared with two readers of the published format: `make bench-loader`.

All read the same histories (bundled ones, rotated by complete episodes) and make the same windows:

    published   h5py, float32 gzip-6, chunks of 4096, slices merged per history, 512 MB chunk cache, one thread
    fair        the same data in chunks of 500, read_direct into a preallocated batch
    ours        ram, mmap, stream (with and without decoded chunks kept); states, uint8, float32; batch buffers reused

Readers take turns, round by round; a ratio is the median over rounds of the ratio within a round. One JSON line each,
with the targets.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np

from benchmarks.common import elapsed, folder_size, print_line
from benchmarks.histories import write_many
from icrl4aht_data import load_icrl4aht
from icrl4aht_data.commands.options import COUNT
from icrl4aht_data.overcooked.observe import observe
from icrl4aht_data.sampling.ad import ADSampler
from icrl4aht_data.utils.system import in_slices
from icrl4aht_data.writing.convert import to_release
from icrl4aht_data.writing.published import to_published

_LEAST_RATIOS = {  # (cache, observations) -> targets: ratio to the published and to the fair reader
    ("ram", "state"): (1000, 200),
    ("ram", "uint8"): (200, 40),
    ("ram", "float32"): (100, 20),
    ("mmap", "state"): (500, 100),
    ("stream", "state"): (100, None),
    ("stream, nothing kept", "state"): (100, None),
}
_READ = ("obs", "actions", "rewards", "dones")


_print = partial(print_line, "loader")


def resident_memory() -> int:
    """Resident memory of this process now, in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def make_data(folder: Path, layout: str, histories: int) -> None:
    """Write the same histories as lite, full, published and fair, unless they exist."""
    if (folder / "done").exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    lite = write_many(folder / "lite", [layout], histories)
    dataset = load_icrl4aht(lite)
    to_release(dataset, folder / "full", "full")
    to_published(dataset, folder / "published", states=False)
    to_published(dataset, folder / "fair", chunk=500, states=False)
    (folder / "done").touch()


def published_reader(path: Path, length: int) -> Callable[[np.ndarray, np.ndarray], dict[str, np.ndarray]]:
    """A reader like the published code: one slice per history for windows that overlap, cut and stacked."""
    file = h5py.File(path / "histories.h5", "r", rdcc_nbytes=512 * 2**20)

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


def fair_reader(path: Path, length: int, batch: int) -> Callable[[np.ndarray, np.ndarray], dict[str, np.ndarray]]:
    """A reader of chunks that fit the windows, directly into one batch buffer."""
    file = h5py.File(path / "histories.h5", "r")
    first: Any = {name: file[f"/0/{name}"] for name in _READ}
    out = {name: np.ones((batch, length, *data.shape[1:]), data.dtype) for name, data in first.items()}

    def read(ids: np.ndarray, starts: np.ndarray) -> dict[str, np.ndarray]:
        for row, (history, start) in enumerate(zip(ids.tolist(), starts.tolist(), strict=True)):
            for name, array in out.items():
                dataset: Any = file[f"/{history}/{name}"]
                dataset.read_direct(array, np.s_[start : start + length], np.s_[row])
        return out

    return read


def memcpy_rate(size: int, threads: int) -> float:
    """Bytes/s of copying a buffer of that size onto another one that has been written before."""
    size = min(size, 2**29)
    source, target = np.ones(size, np.uint8), np.ones(size, np.uint8)

    def part(start: int, stop: int) -> None:
        target[start:stop] = source[start:stop]

    return size / min(elapsed(lambda: in_slices(part, size, threads)) for _ in range(5))


def compare_readers(folder: Path, batch: int, length: int, rounds: int, threads: int, peer_windows: int) -> None:
    """Measure our samplers with every cache and observation, and both peers."""
    windows_of = load_icrl4aht(folder / "lite", threads=threads).ad(batch_size=batch, length=length, seed=1).windows
    peers = {
        "published": published_reader(folder / "published", length),
        "fair": fair_reader(folder / "fair", length, peer_windows),
    }
    readers = LoaderTimes(folder, batch, length, threads)
    seconds_per_window: dict[str, list[float]] = {"published": [], "fair": []}
    for i in range(rounds):
        ids, starts = (drawn[:peer_windows] for drawn in windows_of(i))
        for name, read in peers.items():
            taken = elapsed(lambda read=read, ids=ids, starts=starts: read(ids, starts))
            seconds_per_window[name].append(taken / peer_windows)
        for obs in ("state", "uint8", "float32"):
            for cache in ("ram", "mmap", "stream", "stream, nothing kept"):
                if obs == "state" or cache != "stream, nothing kept":
                    readers.measure(cache, obs, i)
    for name, times in seconds_per_window.items():
        taken = statistics.median(times)
        _print(reader=name, windows_per_second=round(1 / taken, 1), seconds_per_batch=round(taken * batch, 2))
    for (cache, obs), times in readers.times.items():
        print_reader(cache, obs, times, seconds_per_window, batch)


class LoaderTimes:
    """Times of our samplers by cache and observation, each opened once.

    They share one batch buffer at a time, since a float32 batch is large.
    """

    def __init__(self, folder: Path, batch: int, length: int, threads: int) -> None:
        self._dataset, self._threads = load_icrl4aht(folder / "lite", threads=threads), threads
        self._batch, self._length = batch, length
        self._samplers: dict[tuple[str, str], ADSampler] = {}
        self._obs, self._buffer = "", None
        self.times: dict[tuple[str, str], list[dict[str, float]]] = {}

    def measure(self, cache: str, obs: Any, number: int) -> None:
        """Add the median time of a few batches, and the copying rate and memory at that time."""
        sampler = self._samplers.get((cache, obs))
        if sampler is None:
            held: Any = cache.split(",")[0]
            dataset = self._dataset.with_options(cache=held, obs=obs)
            sampler = self._samplers[cache, obs] = dataset.ad(batch_size=self._batch, length=self._length, seed=1)
        if obs != self._obs:
            self._buffer = None
            self._obs, self._buffer = obs, sampler.empty()
        sampler.batch(10**6, self._buffer)  # decodes chunks, and maps the buffer's pages

        def seconds_of(i: int) -> float:
            if cache == "stream, nothing kept":
                sampler.dataset.forget_chunks()
            return elapsed(lambda: sampler.batch(i, self._buffer))

        repeats = {"state": 10, "uint8": 3, "float32": 3}[obs]
        taken = statistics.median(seconds_of(1000 * number + k) for k in range(1, repeats + 1))
        size = sum(array.nbytes for array in self._buffer or () if array is not None)
        facts = {"seconds": taken, "bytes": size, "memcpy": memcpy_rate(size, self._threads)}
        facts["resident"] = resident_memory()
        self.times.setdefault((cache, obs), []).append(facts)


def print_reader(
    cache: str, obs: str, times: list[dict[str, float]], peers: dict[str, list[float]], batch: int
) -> None:
    """Print the line of one of our caches; `peers` has seconds per window by round."""
    own = statistics.median(row["seconds"] for row in times)
    ratios = {
        name: round(statistics.median(p * batch / row["seconds"] for p, row in zip(peer, times, strict=True)), 1)
        for name, peer in peers.items()
    }
    _print(
        reader="ours",
        cache=cache,
        obs=obs,
        milliseconds_per_batch=round(own * 1000, 2),
        batches_per_second=round(1 / own, 2),
        windows_per_second=round(batch / own),
        gigabytes_per_second=round(times[0]["bytes"] / own / 1e9, 2),
        of_memcpy=round(statistics.median(r["bytes"] / r["seconds"] / r["memcpy"] for r in times), 3),
        memcpy_gigabytes_per_second=round(statistics.median(row["memcpy"] for row in times) / 1e9, 2),
        resident_gigabytes=round(times[-1]["resident"] / 1e9, 2),
        times_published=ratios["published"],
        times_fair=ratios["fair"],
        targets=_LEAST_RATIOS.get((cache, obs), (None, None)),
    )


def print_sizes(folder: Path) -> None:
    """Print the size of every format."""
    transitions = int(load_icrl4aht(folder / "lite").column("T").sum())
    for name in ("lite", "full", "published", "fair"):
        size = folder_size(folder / name)
        _print(format=name, megabytes=round(size / 1e6, 1), bytes_per_transition=round(size / transitions, 2))


def train_step_waits(folder: Path, batch: int, length: int, steps: int) -> None:
    """Share of a training step that waits for data; the step is jitted and renders states, batches are prefetched."""
    import jax
    import jax.numpy as jnp

    dataset = load_icrl4aht(folder / "lite", obs="state", cache="ram")
    layout = dataset.layouts[0]
    sampler = dataset.ad(batch_size=batch, length=length, seed=2)
    width = 128
    inputs = int(np.prod(layout.obs_shape))
    first, last = jax.random.split(jax.random.key(0))
    weights = {"in": jax.random.normal(first, (inputs, width)) * 0.02, "out": jax.random.normal(last, (width, 6)) * 0.1}

    @jax.jit
    def train(weights: Any, batch: Any) -> Any:
        obs = observe(layout, batch.obs, 0).astype(jnp.float32).reshape(*batch.obs.shape[:2], inputs)

        def loss(weights: Any) -> Any:
            logits = jax.nn.gelu(obs @ weights["in"]) @ weights["out"]
            chosen = jnp.take_along_axis(jax.nn.log_softmax(logits), batch.target_actions[..., None], axis=-1)
            return -(chosen[..., 0] * batch.attention_mask).mean()

        return jax.tree.map(lambda w, g: w - 0.1 * g, weights, jax.grad(loss)(weights))

    with sampler.batches(device=jax.devices()[0]) as batches:
        for _ in range(2):
            weights = jax.block_until_ready(train(weights, next(batches)))
        waited, started = batches.waited, time.perf_counter()
        for _ in range(steps):
            weights = jax.block_until_ready(train(weights, next(batches)))
        total = time.perf_counter() - started
        share = (batches.waited - waited) / total
    _print(
        step="renders inside jit",
        device=jax.devices()[0].device_kind,
        batch=batch,
        length=length,
        milliseconds_per_step=round(1000 * total / steps, 1),
        waiting_percent=round(100 * share, 2),
        target_percent=2,
    )


def flat_memory(folder: Path, batches: int) -> None:
    """Print resident memory after a tenth of many batches and after all of them."""
    for cache in ("ram", "mmap", "stream"):
        sampler = load_icrl4aht(folder / "lite", cache=cache, obs="uint8").ad(batch_size=16, length=100)
        with sampler.batches(stop=batches) as made:
            for _ in range(batches // 10):
                next(made)
            early = resident_memory()
            for _ in made:
                pass
        late = resident_memory()
        _print(memory=cache, batches=batches, early_megabytes=round(early / 1e6), late_megabytes=round(late / 1e6))


_OPEN_INDEX = """
import json, resource, sys, time
from pathlib import Path
from icrl4aht_data.format.index import read_index
clock = [time.perf_counter()]
def lap():
    clock.append(time.perf_counter())
    return round(clock[-1] - clock[-2], 6)
index = read_index(Path(sys.argv[1]))
facts = {"open_seconds": lap(), "processor_seconds_with_imports": round(time.process_time(), 2)}
entry = index.entry(len(index.entries) * 3 // 4)
facts["id_seconds"] = lap()
facts["task_histories"] = len(index.query(task_id=entry.task_id))
facts["task_query_seconds"] = lap()
facts["layout_histories"] = len(index.query(layout=entry.layout, split=entry.split, teammate_family="H4"))
facts["layout_query_seconds"] = lap()
print(json.dumps(facts | {"peak_megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024}))
"""


def index_times(folder: Path, lines: int) -> None:
    """Print the times of opening a long index, each in its own process, the first with an empty cache folder."""
    root = folder / f"index-{lines}"
    if not (root / "meta" / "info.json").exists():
        write_long_index(root, lines)
    with_cache = os.environ | {"ICRL4AHT_CACHE_DIR": str(folder / "index-cache")}
    shutil.rmtree(folder / "index-cache", ignore_errors=True)
    for opening, most in (("first", 10), ("second", 0.05), ("third", 0.05)):
        run = subprocess.run(
            [sys.executable, "-c", _OPEN_INDEX, str(root)], env=with_cache, capture_output=True, text=True, check=True
        )
        _print(index=opening, lines=lines, target_open_seconds=most, **json.loads(run.stdout))


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


PARTS_OF_LOADER = ("index", "size", "read", "step", "memory")


@click.command()
@click.option("--folder", type=click.Path(path_type=Path), default=Path("build/bench-loader"), show_default=True)
@click.option("--part", "parts", multiple=True, type=click.Choice(PARTS_OF_LOADER), default=PARTS_OF_LOADER)
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
    """Measure the loader and two readers of the published format; one JSON line each."""
    if set(parts) - {"index"}:
        make_data(folder, layout, histories)
    os.environ.setdefault("ICRL4AHT_CACHE_DIR", str(folder.resolve() / "cache"))
    if "index" in parts:
        index_times(folder, lines)
    if "size" in parts:
        print_sizes(folder)
    if "read" in parts:
        compare_readers(folder, **read, peer_windows=peer_windows or read["batch"])
    if "step" in parts:
        train_step_waits(folder, batch=256, length=read["length"], steps=10)
    if "memory" in parts:
        flat_memory(folder, 2000)


if __name__ == "__main__":
    main()

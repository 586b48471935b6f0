"""Shared by the benchmarks: JSON lines, timing, and ratios of two readers, environments or learners run in turn."""

from __future__ import annotations

import json
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click


def print_line(benchmark: str, **facts: Any) -> None:
    """Print one JSON line of a benchmark."""
    click.echo(json.dumps({"benchmark": benchmark, **facts}))


def elapsed(work: Callable[[], Any]) -> float:
    """Seconds that a call takes."""
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def compiled_call(function: Callable[[Any], Any], key: Any) -> Callable[[], Any]:
    """A compiled call of a JAX function with a key, which waits for the result."""
    import jax  # readers are measured without it

    compiled = jax.jit(function).lower(key).compile()
    return lambda: jax.block_until_ready(compiled(key))


def rates_in_turn(
    ours: Callable[[], Any], peer: Callable[[], Any], steps: int, rounds: int
) -> list[tuple[float, float]]:
    """Steps/s of (ours, peer) in every round; they take turns, so that both meet the same load of the machine.

    Args:
        ours: does `steps` steps and waits for the result; compiled.
        peer: the same work of the peer.
        steps: of one call.
        rounds: measured calls of each.
    """
    return [(steps / elapsed(ours), steps / elapsed(peer)) for _ in range(rounds)]


def ratio_facts(pairs: list[tuple[float, float]], peer: str, digits: int | None = None, ratio_digits: int = 1) -> dict:
    """Median steps/s of both, and median, least and greatest ratio of ours to the peer within a round.

    Args:
        pairs: steps/s of (ours, peer) by round.
        peer: prefix of the peer's key.
        digits: decimals of steps/s.
        ratio_digits: decimals of ratios.
    """
    ratios = [ours / theirs for ours, theirs in pairs]
    return {
        "steps_per_second": round(statistics.median(ours for ours, _ in pairs), digits),
        f"{peer}_steps_per_second": round(statistics.median(theirs for _, theirs in pairs), digits),
        "ratio": round(statistics.median(ratios), ratio_digits),
        "ratio_min": round(min(ratios), ratio_digits),
        "ratio_max": round(max(ratios), ratio_digits),
    }


def folder_size(folder: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def peak_memory() -> float:
    """Highest resident memory of this process so far, in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

"""Helpers for the benchmarks: JSON lines, comparisons with other implementations, and FLOP counts.

Compared implementations take turns in rounds, so that the load of the machine is similar for all of them. A reported
ratio is the median over rounds of the ratio within a round.
"""

from __future__ import annotations

import json
import math
import resource
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import click


def print_line(benchmark: str, **facts: Any) -> None:
    """Print one JSON line of a benchmark."""
    click.echo(json.dumps({"benchmark": benchmark, **facts}))


def elapsed(work: Callable[[], Any]) -> float:
    """Call a function. Return the duration of the call in seconds."""
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def measure_rates(
    ways: Mapping[str, Callable[[], Any]], steps: float | Mapping[str, float], rounds: int
) -> dict[str, list[float]]:
    """Measure implementations in turn. Return the steps/s of each implementation in each round, by name.

    Args:
        ways: name of an implementation -> compiled function that waits for its result.
        steps: number of steps per call, or name of an implementation -> its number of steps.
        rounds: number of measured calls per implementation.
    """
    rates: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, work in ways.items():
            rates[name].append((steps[name] if isinstance(steps, Mapping) else steps) / elapsed(work))
    return rates


def compare_rates(rates: Mapping[Any, list[float]], way: Any, peer: str) -> dict[str, float]:
    """Return median steps/s of an implementation and its peer, and median, minimum and maximum of their ratio."""
    ratios = [ours / theirs for ours, theirs in zip(rates[way], rates[peer], strict=True)]
    facts = {
        "steps_per_second": statistics.median(rates[way]),
        f"{peer}_steps_per_second": statistics.median(rates[peer]),
        "ratio": statistics.median(ratios),
        "ratio_min": min(ratios),
        "ratio_max": max(ratios),
    }
    return {name: float(f"{value:.4g}") for name, value in facts.items()}


def compiled_call(function: Callable[[Any], Any], key: Any) -> Callable[[], Any]:
    """Compile a JAX function. Return a function that calls it with `key` and waits for the result."""
    import jax  # imported here, because readers are measured without JAX

    compiled = jax.jit(function).lower(key).compile()
    return lambda: jax.block_until_ready(compiled(key))


class MeasuredProgram(NamedTuple):
    """Compiled function with its costs.

    Attributes:
        call: the compiled function.
        flops: floating-point operations of the matrix products, see `product_flops`.
        compile_seconds: duration of tracing and compilation in seconds.
        bytes: device memory that the compiler planned for arguments, results and temporary arrays.
    """

    call: Callable[..., Any]
    flops: float
    compile_seconds: float
    bytes: int


def compile_and_measure(function: Any, *arguments: Any, **options: Any) -> MeasuredProgram:
    """Compile a jitted function for given arguments and XLA options, and measure its costs."""
    started = time.perf_counter()
    traced = function.trace(*arguments)
    compiled = traced.lower().compile(compiler_options=options)
    seconds = time.perf_counter() - started
    memory, planned = compiled.memory_analysis(), 0
    if memory is not None:
        planned = memory.argument_size_in_bytes + memory.output_size_in_bytes - memory.alias_size_in_bytes
        planned += memory.temp_size_in_bytes
    return MeasuredProgram(compiled, product_flops(traced.jaxpr), seconds, planned)


def product_flops(program: Any) -> float:
    """Return the number of floating-point operations in a program's matrix products, 2 * M * N * K for each.

    All iterations of a loop are counted if their number is known (`scan`, `lax.map`), otherwise one iteration. In a
    conditional, only the most expensive branch is counted. Other operations, such as softmax and the optimizer, are
    not counted. Recomputation is counted only if the program requests it (`jax.checkpoint`).

    Args:
        program: a jaxpr, closed or not, such as `jax.jit(f).trace(..).jaxpr`.
    """
    total = 0.0
    for equation in getattr(program, "jaxpr", program).eqns:
        name = equation.primitive.name
        if name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            left, result = equation.invars[0].aval.shape, equation.outvars[0].aval.shape
            total += 2.0 * math.prod(result) * math.prod(left[axis] for axis in contracted)
        inner = [product_flops(part) for part in _inner_programs(equation.params)]
        if name == "cond":
            total += max(inner)
        else:
            total += sum(inner) * (equation.params["length"] if name == "scan" else 1)
    return total


def _inner_programs(params: dict[str, Any]) -> Iterator[Any]:
    for value in params.values():
        for part in value if isinstance(value, (tuple, list)) else (value,):
            if hasattr(part, "eqns") or hasattr(getattr(part, "jaxpr", None), "eqns"):
                yield part


def folder_size(folder: Path) -> int:
    """Return the total size in bytes of all files in a folder and its subfolders."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def peak_memory() -> float:
    """Return the peak resident memory of this process so far, in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

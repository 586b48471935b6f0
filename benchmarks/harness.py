"""Helpers of the benchmarks: JSON lines, comparison with a peer in rounds, child processes, and FLOP counts.

Implementations take turns, round by round, so the load of the machine is similar for all. A ratio is the
median over rounds of the ratio within a round.
"""

from __future__ import annotations

import json
import math
import resource
import statistics
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from threading import Timer
from typing import Any, NamedTuple

import click


def print_line(benchmark: str, **facts: Any) -> None:
    """Print one JSON line of a benchmark."""
    click.echo(json.dumps({"benchmark": benchmark, **facts}))


def elapsed(work: Callable[[], Any]) -> float:
    """Return the seconds that a call takes."""
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def rates_in_turn(
    ways: Mapping[str, Callable[[], Any]], steps: float | Mapping[str, float], rounds: int
) -> dict[str, list[float]]:
    """Return steps/s of every implementation in every round.

    Args:
        ways: name -> compiled call of an implementation, which waits for its result.
        steps: steps per call, one number or one for each name.
        rounds: measured calls per implementation.
    """
    rates: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, work in ways.items():
            rates[name].append((steps[name] if isinstance(steps, Mapping) else steps) / elapsed(work))
    return rates


def compared(rates: Mapping[Any, list[float]], way: Any, peer: str) -> dict[str, float]:
    """Return the median steps/s of an implementation and its peer, and median, least and greatest ratio by round."""
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
    """Return a compiled call of a JAX function with a key, which waits for the result."""
    import jax  # not at the top: readers are measured without JAX

    compiled = jax.jit(function).lower(key).compile()
    return lambda: jax.block_until_ready(compiled(key))


class MeasuredProgram(NamedTuple):
    """A compiled function with its cost.

    Attributes:
        call: the compiled function.
        flops: operations of its matrix products, see `product_flops`.
        compile_seconds: time of tracing and compiling.
        bytes: device memory of arguments, results and temporary arrays, as the compiler planned it.
    """

    call: Callable[..., Any]
    flops: float
    compile_seconds: float
    bytes: int


def compile_measured(function: Any, *arguments: Any) -> MeasuredProgram:
    """Compile a jitted function for these arguments."""
    started = time.perf_counter()
    traced = function.trace(*arguments)
    compiled = traced.lower().compile()
    seconds = time.perf_counter() - started
    memory, planned = compiled.memory_analysis(), 0
    if memory is not None:
        planned = memory.argument_size_in_bytes + memory.output_size_in_bytes - memory.alias_size_in_bytes
        planned += memory.temp_size_in_bytes
    return MeasuredProgram(compiled, product_flops(traced.jaxpr), seconds, planned)


def product_flops(program: Any) -> float:
    """Return the floating-point operations of a program's matrix products, 2 * M * N * K each.

    Loops of a known length (`scan`, `lax.map`) count every round, other loops one, and a condition its most expensive
    branch. Everything else, such as lookups, softmax and the optimizer, counts nothing. Recomputation counts only if
    the program itself asks for it (`jax.checkpoint`).

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


PrintFacts = Callable[[str, Mapping[str, Any]], None]
"""Called with the name of a case and the facts of its line."""


def run_isolated(
    cases: Sequence[str],
    command: Callable[[Sequence[str]], list[str]],
    print_facts: PrintFacts,
    *,
    until: float,
    case_seconds: float,
    environment: Mapping[str, str] | None = None,
) -> int:
    """Run cases in a child process, and in a new one after each failure, and return the number of failures.

    So a crash or full memory affects one case only.

    A child runs its cases in order and prints one JSON object for each to stdout, with the name as "case"; it ends
    after one with "error". A case without a result (child crashed, stopped or never started) gets a line, too.

    Args:
        cases: names of the cases.
        command: names -> command line of a child that runs them.
        print_facts: prints one line.
        until: `time.monotonic()` at which the running child is killed and no other is started.
        case_seconds: limit of a single case, the start of its process included.
        environment: environment variables of the children; inherited by default.
    """
    pending, failures = list(cases), 0
    while pending and time.monotonic() < until:
        failed, stopped, line, left = False, False, " ", 0.0
        with subprocess.Popen(command(pending), stdout=subprocess.PIPE, text=True, env=environment) as child:
            assert child.stdout is not None
            while line:
                left = until - time.monotonic()
                timer = Timer(max(0.0, min(left, case_seconds)), child.kill)
                timer.start()
                line = child.stdout.readline()
                stopped = not timer.is_alive()
                timer.cancel()
                if line.startswith("{"):  # other output is dropped
                    facts = json.loads(line)
                    failed = "error" in facts
                    print_facts(pending.pop(0), {name: value for name, value in facts.items() if name != "case"})
        if pending and not failed:
            why = f"the process ended with code {child.returncode}"
            if stopped:
                why = "stopped: no time left" if left < case_seconds else f"stopped after {case_seconds:.0f} s"
            print_facts(pending.pop(0), {"error": why})
            failed = True
        failures += failed
    for case in pending:
        print_facts(case, {"skipped": "no time left"})
    return failures


def folder_size(folder: Path) -> int:
    """Return the bytes of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def peak_memory() -> float:
    """Return the highest resident memory of this process so far, in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

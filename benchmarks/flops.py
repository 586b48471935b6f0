"""Compiled programs with the number of floating-point operations in their matrix products."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax


class MeasuredProgram(NamedTuple):
    """A compiled function.

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
    memory = compiled.memory_analysis()
    planned = 0
    if memory is not None:
        planned = memory.argument_size_in_bytes + memory.output_size_in_bytes - memory.alias_size_in_bytes
        planned += memory.temp_size_in_bytes
    return MeasuredProgram(compiled, product_flops(traced.jaxpr), seconds, planned)


def product_flops(program: Any) -> float:
    """Returns the floating-point operations of a program's matrix products, 2 * M * N * K each.

    Loops of a known length (`scan`, `lax.map`) count every round, other loops one, and a condition its dearest branch.
    Everything else, such as lookups, softmax and the optimizer, counts nothing. So does recomputation only if the
    program itself asks for it (`jax.checkpoint`).

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


def device_memory() -> dict[str, float]:
    """Returns GiB of memory in use, the highest so far in this process, and the limit; nothing on a CPU."""
    found = jax.local_devices()[0].memory_stats() or {}
    names = {"bytes_in_use": "in_use_gib", "peak_bytes_in_use": "process_peak_gib", "bytes_limit": "limit_gib"}
    return {name: gib(found[key]) for key, name in names.items() if key in found}


def gib(count: int) -> float:
    """Returns a number of bytes in GiB."""
    return round(count / 2**30, 3)

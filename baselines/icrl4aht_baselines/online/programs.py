"""One compiled program for many layouts whose programs differ in constant arrays alone.

A layout is static: the functions of an environment, of a heuristic and of the oracle contain its tables as constants,
and every other layout needs a compilation of its own, which takes seconds. Layouts with the same rooms and the same
numbers of pots, piles and recipes differ in nothing but the values of these tables. Here they become arguments.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core


class SharedProgram(NamedTuple):
    """Functions that are one program with different constants.

    Attributes:
        members: numbers of the functions.
        constants: constant arrays of the functions, each with a leading axis (members,).
        run: (constants of one function, *arguments) -> its result.
    """

    members: list[int]
    constants: list[np.ndarray]
    run: Callable[..., Any]

    def repeated(self, rows: Sequence[int]) -> SharedProgram:
        """Return the program of some of the members by their positions, each as often as it is named."""
        return self._replace(
            members=[self.members[row] for row in rows], constants=[one[list(rows)] for one in self.constants]
        )


def shared_programs(functions: Sequence[Callable[..., Any]], *arguments: Any) -> list[SharedProgram]:
    """Trace functions and sort them by the programs that they are; most often all are one program.

    Args:
        functions: pure functions of the same arguments.
        arguments: pytrees of arrays, or of their shapes and dtypes, to trace the functions with.
    """
    traced = [jax.make_jaxpr(function, return_shape=True)(*arguments) for function in functions]
    found: dict[str, list[int]] = defaultdict(list)
    for number, (closed, shapes) in enumerate(traced):
        _check_hoisted(closed.jaxpr)
        found[f"{closed.jaxpr}\n{jax.tree.structure(shapes)}"].append(number)
    return [_shared(members, [traced[number] for number in members]) for members in found.values()]


def _shared(members: list[int], traced: Sequence[tuple[Any, Any]]) -> SharedProgram:
    constants = [
        np.stack([np.asarray(one) for one in each]) for each in zip(*(c.consts for c, _ in traced), strict=True)
    ]
    closed, shapes = traced[0]
    tree = jax.tree.structure(shapes)

    def run(own: Sequence[Any], *arguments: Any) -> Any:
        program = core.jaxpr_as_fun(core.ClosedJaxpr(closed.jaxpr, list(own)))
        return jax.tree.unflatten(tree, program(*jax.tree.leaves(arguments)))

    return SharedProgram(members, constants, run)


def _check_hoisted(jaxpr: core.Jaxpr) -> None:
    """Check that all constant arrays of a program are constants of its outermost level, where they are replaced."""
    for equation in jaxpr.eqns:
        for each in equation.invars:
            assert not (isinstance(each, core.Literal) and np.ndim(each.val)), equation
        for value in jax.tree.leaves(
            equation.params, is_leaf=lambda one: isinstance(one, (core.Jaxpr, core.ClosedJaxpr))
        ):
            if isinstance(value, core.ClosedJaxpr):
                assert not value.consts, equation
                _check_hoisted(value.jaxpr)
            elif isinstance(value, core.Jaxpr):
                _check_hoisted(value)


def run_all(program: SharedProgram, shared: int, *arguments: Any) -> Any:
    """Run the functions of a program at once.

    Args:
        program: the program.
        shared: number of leading arguments that are the same for all functions; the others have a leading axis
            (members,), and so has the result.
        arguments: arguments of the functions.
    """
    axes = (0, *[None] * shared, *[0] * (len(arguments) - shared))
    return jax.vmap(program.run, in_axes=axes)([jnp.asarray(one) for one in program.constants], *arguments)

"""Counts of floating-point operations in matrix products."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

from benchmarks.harness import product_flops


def counted(function, *shapes) -> float:
    return product_flops(jax.jit(function).trace(*[jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]).jaxpr)


def test_products_of_matrices_and_of_batches():
    assert counted(lambda a, b: a @ b, (3, 5), (5, 7)) == 2 * 3 * 5 * 7
    assert (
        counted(lambda q, k: jnp.einsum("bqhd,bkhd->bhqk", q, k), (2, 3, 4, 5), (2, 6, 4, 5)) == 2 * 2 * 4 * 3 * 6 * 5
    )
    assert counted(lambda a: jnp.exp(a).sum(), (3, 5)) == 0


def test_the_backward_pass_has_two_products_for_each_of_the_forward_pass():
    def loss(x, kernel):
        return jnp.square(jnp.tanh(x @ kernel)).sum()

    assert counted(jax.grad(loss, (0, 1)), (3, 5), (5, 7)) == 3 * 2 * 3 * 5 * 7


def test_loops_count_every_round_and_conditions_the_most_expensive_branch():
    def loop(x, kernel):
        return jax.lax.scan(lambda x, _: (x @ kernel, None), x, length=11)[0]

    def condition(x, kernel):
        return jax.lax.cond(x[0, 0] > 0, lambda x: jax.jit(loop)(x, kernel), lambda x: x @ kernel, x)

    assert counted(loop, (3, 5), (5, 5)) == 11 * 2 * 3 * 5 * 5
    assert counted(condition, (3, 5), (5, 5)) == 11 * 2 * 3 * 5 * 5


def custom_gradient(function):
    found = jax.custom_vjp(function)
    found.defvjp(lambda *inputs: (function(*inputs), inputs), lambda inputs, cotangent: inputs)
    return found


@pytest.mark.parametrize("wrap", [jax.jit, jax.checkpoint, custom_gradient])
def test_functions_inside_transformations_count(wrap):
    assert counted(wrap(lambda a, b: a @ b), (3, 5), (5, 7)) == 2 * 3 * 5 * 7
    assert counted(jax.vmap(wrap(lambda a, b: a @ b)), (4, 3, 5), (4, 5, 7)) == 4 * 2 * 3 * 5 * 7

"""Test `product_flops`, which counts the floating-point operations of a program's matrix products."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

from benchmarks.harness import product_flops


def count_flops(function, *shapes) -> float:
    return product_flops(jax.jit(function).trace(*[jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]).jaxpr)


def test_operations_of_matrix_products_and_batched_products_are_counted():
    assert count_flops(lambda a, b: a @ b, (3, 5), (5, 7)) == 2 * 3 * 5 * 7
    assert (
        count_flops(lambda q, k: jnp.einsum("bqhd,bkhd->bhqk", q, k), (2, 3, 4, 5), (2, 6, 4, 5))
        == 2 * 2 * 4 * 3 * 6 * 5
    )
    assert count_flops(lambda a: jnp.exp(a).sum(), (3, 5)) == 0


def test_backward_pass_has_two_matrix_products_for_each_forward_product():
    def loss(x, kernel):
        return jnp.square(jnp.tanh(x @ kernel)).sum()

    assert count_flops(jax.grad(loss, (0, 1)), (3, 5), (5, 7)) == 3 * 2 * 3 * 5 * 7


def test_all_iterations_of_a_loop_and_the_costliest_branch_are_counted():
    def loop(x, kernel):
        return jax.lax.scan(lambda x, _: (x @ kernel, None), x, length=11)[0]

    def condition(x, kernel):
        return jax.lax.cond(x[0, 0] > 0, lambda x: jax.jit(loop)(x, kernel), lambda x: x @ kernel, x)

    assert count_flops(loop, (3, 5), (5, 5)) == 11 * 2 * 3 * 5 * 5
    assert count_flops(condition, (3, 5), (5, 5)) == 11 * 2 * 3 * 5 * 5


def custom_gradient(function):
    found = jax.custom_vjp(function)
    found.defvjp(lambda *inputs: (function(*inputs), inputs), lambda inputs, cotangent: inputs)
    return found


@pytest.mark.parametrize("wrap", [jax.jit, jax.checkpoint, custom_gradient])
def test_products_inside_jax_transformations_are_counted(wrap):
    assert count_flops(wrap(lambda a, b: a @ b), (3, 5), (5, 7)) == 2 * 3 * 5 * 7
    assert count_flops(jax.vmap(wrap(lambda a, b: a @ b)), (4, 3, 5), (4, 5, 7)) == 4 * 2 * 3 * 5 * 7

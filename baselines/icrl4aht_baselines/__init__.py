"""Reference agents and the one evaluator of the benchmark."""

from icrl4aht_data.utils.without_jax import explain_missing_jax

explain_missing_jax(__name__)

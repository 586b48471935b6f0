"""Rebuilds the ICRL4AHT dataset from the environment and the teammates."""

from icrl4aht_data.utils.without_jax import explain_missing_jax

explain_missing_jax(__name__)

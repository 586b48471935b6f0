"""OvercookedV2 for batches in NumPy or JAX arrays: layouts, state records, rules, observations and pictures."""

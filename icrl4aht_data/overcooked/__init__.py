"""OvercookedV2: layouts, state record, rules, observations, pictures. Batch first, for NumPy and JAX, no randomness."""

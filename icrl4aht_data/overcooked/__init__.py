"""OvercookedV2 for NumPy and JAX arrays, batch axes first: layouts, state records, rules, observations, pictures."""

"""OvercookedV2 for NumPy and JAX, batch axes first: layouts, state record, rules, observations, pictures."""

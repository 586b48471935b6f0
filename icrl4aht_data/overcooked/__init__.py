"""OvercookedV2: layouts, state record, rules, observations, pictures. The functions take NumPy or JAX arrays, batch axes first."""

"""The game: maps, state record, rules, observations, frames. Batch first, NumPy or JAX, no randomness of its own."""

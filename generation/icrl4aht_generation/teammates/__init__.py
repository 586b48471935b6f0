"""Teammates as pure JAX functions. `registry.build_teammate` makes one from a task's teammate entry."""

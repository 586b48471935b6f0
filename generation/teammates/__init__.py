"""Teammates as pure JAX functions. `registry.build` makes one from a task's teammate entry."""

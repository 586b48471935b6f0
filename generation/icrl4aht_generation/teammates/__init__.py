"""Teammates as pure JAX functions; `registry.build_teammate` builds a teammate from an entry of a task."""

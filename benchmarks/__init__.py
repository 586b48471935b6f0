"""Benchmarks as commands: JSON lines, with the peer measured in the same run."""

"""Benchmark commands that print JSON lines; a comparison measures both programs in the same run."""

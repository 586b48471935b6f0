"""Benchmark commands, which print JSON lines; both programs of a comparison are measured in the same run."""

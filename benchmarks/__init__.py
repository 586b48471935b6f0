"""Benchmark commands, which print JSON lines and measure compared programs in the same run."""

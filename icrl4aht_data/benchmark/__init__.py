"""The benchmark: tracks, splits, teammate families, tasks, reference returns."""

"""Command line of `python -m baselines`."""

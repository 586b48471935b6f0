"""The command line of `python -m baselines`."""

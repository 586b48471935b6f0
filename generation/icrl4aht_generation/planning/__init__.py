"""Estimates of the cost of generating a release: steps, disk space, hours."""

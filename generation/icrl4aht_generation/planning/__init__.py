"""The cost of a rebuild: steps, disk space, hours."""

"""Collecting learning histories: one task, and all tasks of a profile."""

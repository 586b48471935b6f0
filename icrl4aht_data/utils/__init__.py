"""Utilities for files, hashes, threads, memory, options, plugins and progress bars."""

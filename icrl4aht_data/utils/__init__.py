"""Helpers without knowledge of the dataset: files, paths, hashes, threads, memory, the cache folder."""

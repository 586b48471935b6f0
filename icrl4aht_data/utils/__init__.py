"""Files, paths, hashes, threads, memory, the cache folder and checks of options."""

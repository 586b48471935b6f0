"""Data about the benchmark: constants from the paper, tasks and their manifests, returns of reference egos."""

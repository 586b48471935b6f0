"""The benchmark: facts from the paper, tasks and their manifests, returns of reference egos."""

"""Format of release folders: fields, index, chunk tables, manifest, provenance, checkpoints."""

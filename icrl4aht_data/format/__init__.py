"""The release folder's format: fields, index, chunk tables, manifest, provenance, checkpoints."""

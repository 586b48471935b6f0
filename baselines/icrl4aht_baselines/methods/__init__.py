"""In-context learners: one transformer, one file per method."""

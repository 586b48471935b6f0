"""The in-context learners: one transformer, one file a method."""

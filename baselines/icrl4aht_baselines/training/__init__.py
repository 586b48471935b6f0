"""Training of the in-context learners on releases."""

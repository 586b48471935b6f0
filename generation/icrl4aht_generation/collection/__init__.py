"""Generation of learning histories: one task, or all tasks of a profile."""

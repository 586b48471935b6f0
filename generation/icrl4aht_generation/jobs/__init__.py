"""A queue of long jobs that run in local processes or with Ray, such as tasks, populations and best responses."""

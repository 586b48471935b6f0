"""A queue of long jobs, such as tasks, populations and best responses, that run in local processes or with Ray."""

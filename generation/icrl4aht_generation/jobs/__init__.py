"""A queue of long jobs, run by local processes or Ray: tasks of a rebuild, populations, best responses, trainings."""

"""Learning histories of the ICRL4AHT benchmark: read, sample, fetch, verify."""

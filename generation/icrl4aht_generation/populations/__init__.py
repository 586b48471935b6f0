"""Populations of learned teammates: training, selection, cross-play."""

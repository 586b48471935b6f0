"""Learners of egos and populations, and the network and PPO implementation that they share."""

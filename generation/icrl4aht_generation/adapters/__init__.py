"""Environments for other libraries: Gymnasium, PettingZoo and JaxMARL."""

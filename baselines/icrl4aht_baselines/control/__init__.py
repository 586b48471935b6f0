"""Positive control: small environments in which the methods must adapt in context."""

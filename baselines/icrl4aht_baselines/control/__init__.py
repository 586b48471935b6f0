"""Positive control: small worlds in which the methods must adapt in context."""

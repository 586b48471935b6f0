"""Packing of generated histories into releases, and comparison of releases."""

"""Releases made of collected histories."""

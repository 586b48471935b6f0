"""Releases that are packed from generated histories."""

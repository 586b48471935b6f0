"""Verification of releases."""

"""Scripted experts: egos that see the complete state and need no training."""

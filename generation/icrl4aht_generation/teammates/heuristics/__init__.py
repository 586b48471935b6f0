"""Heuristic teammates of the families H1 to H4 (paper, App. B.2)."""

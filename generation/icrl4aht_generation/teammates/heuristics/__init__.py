"""The heuristic teammates H1 to H4 (paper, App. B.2)."""

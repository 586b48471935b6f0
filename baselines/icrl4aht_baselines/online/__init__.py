"""Training by playing (RL^2, best responses), and recording of histories of trained agents."""

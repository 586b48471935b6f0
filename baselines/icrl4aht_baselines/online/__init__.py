"""Train agents by playing (RL^2, best responses), and record histories that trained agents play."""

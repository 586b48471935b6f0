"""Learning and recording by playing: RL^2, and histories of trained agents."""

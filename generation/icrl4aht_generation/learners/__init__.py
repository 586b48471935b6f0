"""The network and the PPO implementation that all learning algorithms share, and the learners."""

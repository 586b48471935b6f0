"""The one network and the one PPO; each algorithm adds only what differs."""

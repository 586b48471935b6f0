"""Ego agents: reference egos, trained models, and an adapter for agents outside JAX."""

from icrl4aht_baselines.agents.egos import AGENTS, find_agent, stay
from icrl4aht_baselines.agents.host import HostAgent, Percept, from_host

__all__ = ["AGENTS", "HostAgent", "Percept", "find_agent", "from_host", "stay"]

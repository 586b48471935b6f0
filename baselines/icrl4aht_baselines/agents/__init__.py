"""Ego agents: reference egos, trained models, and an adapter for agents outside JAX."""

from icrl4aht_baselines.agents.egos import AGENTS, find_agent, stay
from icrl4aht_baselines.agents.host import EgoInput, HostAgent, from_host

__all__ = ["AGENTS", "EgoInput", "HostAgent", "find_agent", "from_host", "stay"]

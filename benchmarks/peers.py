"""Peers of benchmarks and differential tests: environments of other packages on our layouts."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout

from icrl4aht_data.benchmark.facts import EPISODE_STEPS
from icrl4aht_data.overcooked.layouts import Layout

with redirect_stdout(sys.stderr):  # it prints on import
    from jaxmarl.environments.overcooked_v2.layouts import Layout as PeerLayout
    from jaxmarl.environments.overcooked_v2.overcooked import OvercookedV2


def jaxmarl_environment(layout: Layout, max_steps: int = EPISODE_STEPS) -> OvercookedV2:
    """JaxMARL's OvercookedV2 on our map, with the benchmark's options."""
    return OvercookedV2(
        PeerLayout.from_string("\n".join(layout.rows), possible_recipes=[list(r) for r in layout.recipes]),
        max_steps=max_steps,
        agent_view_size=2,
        random_agent_positions=True,
        negative_rewards=True,
        sample_recipe_on_delivery=True,
        indicate_successful_delivery=layout.indicates_delivery,
    )

"""Test games of people and policies: returns equal those of an evaluation, and egos can play in either slot."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from icrl4aht_baselines.agents.egos import find_agent
from icrl4aht_baselines.evaluate.evaluator import evaluate
from icrl4aht_baselines.evaluate.protocols import Protocol
from icrl4aht_baselines.evaluate.rollout import task_key
from icrl4aht_baselines.play.game import Game, PolicyPlayer, find_partner
from icrl4aht_generation.policy import Policy

from icrl4aht_data.errors import OptionError, UnknownNameError
from icrl4aht_data.overcooked.actions import INTERACT
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.overcooked.observe import observe

LAYOUT = get_layout("demo_wide")
EPISODES, STEPS = 2, 60


@pytest.mark.slow
def test_game_of_two_policies_has_the_returns_of_an_evaluation():
    """A game that uses the NumPy rules gives the same returns as the compiled evaluation."""
    partner = find_partner("H4/t0", LAYOUT, 1)
    assert partner.task
    ego = find_partner("rl2-reference", LAYOUT, 0)
    game = Game(LAYOUT, [ego.player, partner.player], task_key(0, partner.task.task_id), EPISODES, STEPS)
    protocol = Protocol("seeded", "seeded", False, EPISODES, STEPS)
    agent = find_agent("rl2-reference")
    (result,) = evaluate("rl2", agent.make, [partner.task], protocol, played=lambda count: None)
    assert game.play() == result.returns[0]
    again = game.with_players(game.players)
    assert again.play() == game.returns
    np.testing.assert_array_equal(again.arrays()["state"], game.arrays()["state"])


def test_egos_can_play_in_the_teammate_slot():
    """An ego that plays as the teammate gets the teammate's observations, and the oracle can deliver there."""
    seen = []

    def act(params, memory, view, key):
        jax.debug.callback(lambda obs: seen.append(np.asarray(obs)), view.obs)
        return jax.numpy.int32(INTERACT), memory

    watcher = PolicyPlayer(Policy((), lambda params, key: (), act, "ego_input"), LAYOUT, 1, is_ego=True)
    game = Game(LAYOUT, [None, watcher], task_key(0, "x"), 1, 5)
    records = [game.record]
    game.step({0: 2})
    jax.effects_barrier()
    np.testing.assert_array_equal(seen[0], observe(LAYOUT, records[0][None], 1)[0])
    assert game.people == [0]
    cooking = [find_partner("oracle", LAYOUT, slot).player for slot in (0, 1)]
    assert sum(Game(LAYOUT, cooking, task_key(0, "x"), 1, 100).play()) > 0


def test_partner_that_cannot_play_the_layout_is_refused_with_names_of_others():
    """A test teammate cannot play a generated layout, and each partner that the message names can."""
    layout = get_layout("rooms-0-46")
    with pytest.raises(OptionError, match=r"--with H1/t0: test .* found rooms-0-46; .* plays this one: human, stay"):
        find_partner("H1/t0", layout, 1)
    for name in ("stay", "random", "oracle", "search", "rl2-reference"):
        assert find_partner(name, layout, 1).player


def test_find_partner_accepts_known_names_only(tmp_path):
    assert find_partner("human", LAYOUT, 1).player is None
    with pytest.raises(UnknownNameError, match=r"valid: human, stay.*H1/t0.*Did you mean 'oracle'"):
        find_partner("orakel", LAYOUT, 1)
    with pytest.raises(UnknownNameError, match="expected a run folder"):
        find_partner(str(tmp_path), LAYOUT, 1)

"""Record the games of consenting players as a release with source `human`."""

from __future__ import annotations

import re
from importlib.metadata import version
from pathlib import Path

import jax

from icrl4aht_baselines.play.game import Game, Partner
from icrl4aht_data.benchmark.tasks import Task, make_task
from icrl4aht_data.errors import OptionError
from icrl4aht_data.format.provenance import Provenance
from icrl4aht_data.overcooked.actions import TEAMMATE
from icrl4aht_data.writing.release import NewHistory, NewTask, write_release
from icrl4aht_data.writing.release_folder import check_target

FIRST_HUMAN_SEED = 5_000_000
"""Seed of the first task of source `human`; tasks of other sources have smaller seeds."""

HUMAN_SEEDS = 1_000_000
"""Size of the range of seeds for tasks of source `human`."""

CONSENT = """\
This game is recorded: the states of the game, your actions and your partner's, the rewards, whether you saw the \
whole map, the number of steps a second, and the pseudonym that you choose below. Nothing else is stored: no name, no \
address, no time. The record is a folder on the computer that serves this page. Its owner may publish it as data for \
research, under the MIT licence. Finished episodes are written at once. You may stop at any time by closing the page, \
and ask the owner to delete the folder. Take part only if you agree and are of age."""
"""Text that a person has to accept before a recorded game."""

VIEWS = ("ego", "whole")
"""Part of the map that a person sees: "ego" is the window of an ego, "whole" is the complete map."""


def human_task(partner: Partner, seed: int) -> Task:
    """Return the task of a recorded game.

    Args:
        partner: partner of the person; it must be a test teammate.
        seed: number of the game, 0 to `HUMAN_SEEDS` - 1, which determines the initial states of the episodes.

    Raises:
        OptionError: if the partner is not a test teammate, because releases describe teammates by their parameters.
    """
    if partner.task is None:
        raise OptionError(
            "--record: a release describes the teammate by its parameters, which only test teammates have: give "
            "--with H1/t0 to H4/t4, or leave --record out"
        )
    of = partner.task
    return make_task(of.track, of.split, of.layout.name, of.teammate, FIRST_HUMAN_SEED + seed)


def check_pseudonym(pseudonym: object) -> str:
    """Check that a pseudonym has a valid form, and return it.

    Raises:
        OptionError: if the pseudonym does not consist of 2 to 30 letters, digits, hyphens and underscores. This rule
            also excludes e-mail addresses.
    """
    if not isinstance(pseudonym, str) or not re.fullmatch(r"[\w-]{2,30}", pseudonym):
        raise OptionError(f"pseudonym {pseudonym!r:.60}: expected 2 to 30 letters, digits, hyphens and underscores")
    return pseudonym


class GameRecorder:
    """Recorder of a game, which writes a release of all finished episodes whenever an episode ends.

    Args:
        folder: folder of the release.
        task: task of the game.
        ticks: steps per second, which the provenance states.

    Attributes:
        pseudonym: pseudonym of the person; None until the person has agreed to the recording.
        written: number of episodes that the folder holds.
        views: for each finished episode, the members of `VIEWS` that the person saw in it.

    Raises:
        OptionError: if the folder exists and is not empty.
    """

    def __init__(self, folder: Path, task: Task, ticks: float) -> None:
        try:
            check_target(folder, overwrite=False)
        except OptionError as error:
            raise OptionError(f"--record {folder}: exists, expected a new folder; give another one") from error
        self.folder, self.task, self.ticks, self.written = folder, task, ticks, 0
        self.pseudonym: str | None = None
        self.views: list[list[str]] = []

    def write(self, game: Game) -> None:
        """Write the finished episodes of a game into the folder.

        Raises:
            OptionError: if another program has written into the folder.
            DiskFullError: if the disk is full.
        """
        person = {"pseudonym": self.pseudonym, "views": self.views, "steps_per_second": self.ticks}
        made = Provenance(
            code_version=version("icrl4aht-data"),
            jax_version=jax.__version__,
            platform=jax.default_backend(),
            seed=self.task.seed,
            source="human",
            teammate={"slot": TEAMMATE, "noise": "seeded"},
            streams_recorded=1,
            streams_kept=1,
            other={"person": person},
        )
        arrays = game.arrays()
        new = NewTask(self.task, made, 1, lambda: [NewHistory(0, arrays)])
        options = {"data_version": "1.0.0", "kept_steps": game.steps, "overwrite": self.written > 0}
        write_release(self.folder, "lite", [new], **options)
        self.written = len(arrays["episode_end_state"])

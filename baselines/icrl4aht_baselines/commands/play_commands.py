"""Command `icrl4aht-data play`, which serves a web page to play the game on."""

from __future__ import annotations

from pathlib import Path

import click

from icrl4aht_baselines.commands import options as shared
from icrl4aht_data.benchmark.facts import KEPT_STEPS
from icrl4aht_data.commands.options import COUNT, LAYOUT, Folder, Names, accept_any_name, examples
from icrl4aht_data.errors import OptionError
from icrl4aht_data.overcooked.actions import EGO, TEAMMATE
from icrl4aht_data.overcooked.layouts import get_layout
from icrl4aht_data.utils.install_hints import import_optional
from icrl4aht_data.utils.text import counted_noun

_SLOTS = {"ego": EGO, "teammate": TEAMMATE}
_PARTNER = Names("partner", lambda: ["human", *shared.EGO_NAME.valid(), "H1/t0"], accept_any_name)


@click.command(
    "play",
    epilog=examples(
        "icrl4aht-data play --layout cramped_up --with rl2-reference",
        "icrl4aht-data play --with H1/t0 --record build/human",
        "icrl4aht-data play --with human --ticks 4",
    ),
)
@click.option("--layout", type=LAYOUT, default="demo_wide", help="Layout to play.")
@click.option(
    "--with",
    "partner",
    type=_PARTNER,
    default="H4/t0",
    help="Partner: a test teammate, H1/t0 to H4/t4; an agent of `evaluate`, such as oracle or rl2-reference; a run "
    "folder; or human, a second person with another browser.",
)
@click.option("--slot", type=click.Choice(list(_SLOTS)), default="ego", help="Agent that the first person plays.")
@click.option("--episodes", type=COUNT, default=10, help="Episodes of the game.")
@click.option("--steps", type=COUNT, default=KEPT_STEPS, help="Steps of an episode.")
@click.option(
    "--ticks",
    type=click.FloatRange(0, 60),
    default=5,
    help="Steps a second; 0: a step when everyone has acted (the key . stays).",
)
@click.option(
    "--record",
    type=Folder(),
    metavar="FOLDER",
    help="Write the episodes here as a release of source human. Needs a test teammate and --slot ego.",
)
@click.option(
    "--seed",
    type=click.IntRange(0, 999_999),
    help="Seed of the episodes' initial states, and number of the recorded task.",
    show_default="drawn at random",
)
@click.option("--port", type=click.IntRange(0, 65535), default=8000, help="Port of 127.0.0.1; 0: any free one.")
def play_command(
    layout: str,
    partner: str,
    slot: str,
    episodes: int,
    steps: int,
    ticks: float,
    record: Path | None,
    seed: int | None,
    port: int,
) -> None:
    """Play on a web page with a policy or a person.

    Serves the page on this computer only. At the end, the page compares the person's returns with those of the egos
    stay, rl2-reference and oracle in the same episodes, unless the partner is a person. With --record the episodes are
    stored as a history of the person, who has to agree to the recording and chooses a pseudonym.
    """
    for module in ("starlette", "uvicorn", "websockets"):
        import_optional(module, "play")
    from secrets import randbelow

    from icrl4aht_baselines.evaluate.rollout import task_key
    from icrl4aht_baselines.play import recording, server
    from icrl4aht_baselines.play.game import Game, find_partner

    own, known = _SLOTS[slot], get_layout(layout)
    number = randbelow(recording.HUMAN_SEEDS) if seed is None else seed
    found = find_partner(partner, known, 1 - own)
    recorder, name = None, f"play {layout} {partner} {number}"
    if record is not None:
        if own != EGO:
            raise OptionError("--record: only the ego can be recorded: leave out --slot teammate, or --record")
        recorder = recording.GameRecorder(record, task := recording.human_task(found, number), ticks)
        name = task.task_id
    with server.open_port(port) as listener:
        players = [found.player] * 2
        players[own] = None
        game = Game(known, players, task_key(0, name), episodes, steps)
        if found.player:
            game.with_players(players).step({})  # compiles the partner's policy before the game starts
        session = server.PlaySession(game, partner, ticks, recorder)
        who = "two browsers" if found.player is None else "a browser"
        click.echo(f"play at http://{server.HOST}:{listener.getsockname()[1]} in {who} on this computer; Ctrl+C stops")
        server.serve_session(session, listener)
    if recorder and game.returns:
        if recorder.written < len(game.returns):  # an earlier write failed, for example because of a full disk
            recorder.write(game)
        played = counted_noun(len(game.returns), "episode")
        click.echo(f"{record}: {played}; `icrl4aht-data show {record}` describes it")

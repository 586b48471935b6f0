"""Test a game's websocket without a browser: keys, records, lost connections and invalid input."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from icrl4aht_data import load_icrl4aht
from icrl4aht_data.browsing.page import make_browser_page
from icrl4aht_data.checking.verify import verify_release
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.overcooked.actions import ACTIONS, EGO
from icrl4aht_data.overcooked.state import columns
from icrl4aht_data.plotting import plot_learning_curves
from tests.helpers.commands import run_cli

starlette = pytest.importorskip("starlette.testclient", reason="needs the extra play")

from icrl4aht_baselines.play.server import PlaySession, make_app, open_port  # noqa: E402

from tests.helpers.play import LAYOUT, new_session, scripted_person  # noqa: E402

UP, DOWN, LEFT, RIGHT, STAY, INTERACT = range(6)
ORIGIN = {"origin": "http://127.0.0.1"}


class Browser:
    """A browser's connection to the server: it sends messages and stores the last received state."""

    def __init__(self, socket: Any) -> None:
        self.socket, self.setup = socket, socket.receive_json()
        self.frame: dict[str, Any] = socket.receive_json()

    def send(self, **message: Any) -> dict[str, Any]:
        """Send a message to the server and return the answer."""
        self.socket.send_json(message)
        answer = self.socket.receive_json()
        if answer["kind"] == "frame":
            self.frame = answer
        return answer

    def act(self, *actions: int) -> None:
        for action in actions:
            self.send(action=action)


@contextmanager
def open_browser(client: Any, slot: str = "") -> Iterator[Browser]:
    with client.websocket_connect(f"ws://127.0.0.1/play?slot={slot}", headers=ORIGIN) as socket:
        yield Browser(socket)


def make_client(session: PlaySession) -> Any:
    return starlette.TestClient(make_app(session), base_url="http://127.0.0.1")


def test_keys_move_the_agent_by_the_rules():
    session = new_session()
    with make_client(session) as client, open_browser(client) as player:
        text = client.get("/").text
        assert "arrow keys" in text and "The recipe is on the white board and below the whole map." in text
        assert player.setup["actions"] == list(ACTIONS)
        assert (player.frame["waiting"], player.frame["clock"]) == (True, 0)
        player.act(STAY)  # the first key starts the episode without a step
        assert (player.frame["waiting"], player.frame["clock"]) == (False, 0)
        for action in (LEFT, RIGHT, UP, DOWN):
            before = np.array(player.frame["record"])
            player.act(action)
            after, at = np.array(player.frame["record"]), columns(LAYOUT)
            moved = LAYOUT.moves[before[EGO], action]
            other = before[1]
            assert after[at.positions][EGO] == (before[EGO] if moved == other else moved)
        assert player.frame["clock"] == 4


def play_oracle_actions(player: Browser, episodes: int, steps: int) -> None:
    """Play episodes with the oracle's actions instead of a person's keys."""
    act = scripted_person()
    for episode in range(episodes):
        player.act(STAY)
        for t in range(steps):
            player.act(act(player.frame["record"], episode, t))


def test_recorded_game_is_a_valid_release(tmp_path):
    """The record is a valid release with the person's pseudonym. Nothing is written before consent."""
    session = new_session("H2/t3", episodes=2, steps=100, record=tmp_path / "record")
    with make_client(session) as client, open_browser(client) as player:
        assert "Nothing else is stored" in player.setup["consent"]
        player.socket.send_json({"action": LEFT})  # the server ignores keys before the consent
        assert player.send(pseudonym="a@b.org", agrees=True)["kind"] == "problem"
        assert player.send(pseudonym="someone", agrees=False)["kind"] == "problem"
        assert not (tmp_path / "record").exists()
        assert player.send(pseudonym="someone", agrees=True)["consent"] is None
        player.frame = player.socket.receive_json()
        play_oracle_actions(player, 1, 100)
        assert load_icrl4aht(tmp_path / "record")[0].entry.episodes == 1, "each episode is written when it ends"
        player.socket.send_json({"view": "whole"})
        play_oracle_actions(player, 1, 100)
        assert player.frame["over"] and max(player.frame["returns"]) >= 20
    report = verify_release(tmp_path / "record", level="deep")
    assert report.ok, report.findings
    dataset = load_icrl4aht(tmp_path / "record")
    history = dataset[0]
    assert (history.entry.source, history.entry.episodes, history.entry.teammate_family) == ("human", 2, "H2")
    assert history.returns().tolist() == session.game.returns
    made = dataset.provenance[history.entry.task_id]
    person = {"pseudonym": "someone", "views": [["ego"], ["ego", "whole"]], "steps_per_second": 0}
    assert made.other == {"person": person}
    assert "a person plays" in (tmp_path / "record" / "README.md").read_text(encoding="utf-8")
    assert make_browser_page(dataset).shown_episodes == 2
    assert plot_learning_curves(dataset) is not None
    assert dataset.ad(batch_size=2, length=20, seed=0)[0].target_actions.shape == (2, 20)
    with pytest.raises(OptionError, match="record: exists"):
        new_session("H2/t3", record=tmp_path / "record")


def test_game_continues_after_a_lost_connection():
    session = new_session(episodes=1)
    with make_client(session) as client:
        with open_browser(client) as player:
            player.act(STAY, LEFT, RIGHT, INTERACT)
            record = player.frame["record"]
        with open_browser(client) as player:
            assert (player.frame["clock"], player.frame["record"]) == (3, record)
            assert player.frame["waiting"]
            player.act(STAY, *[STAY] * 5)
            assert player.frame["over"] and len(player.frame["returns"]) == 1
            player.socket.send_json({"action": LEFT})  # the server ignores keys after the last episode
            assert player.send(action="x")["kind"] == "problem"


def test_failed_record_write_is_shown_and_retried(tmp_path, monkeypatch):
    session = new_session("H2/t3", episodes=2, steps=3, record=tmp_path / "record")
    assert session.recorder
    session.recorder.pseudonym = "someone"
    with make_client(session) as client, open_browser(client) as player:
        with monkeypatch.context() as patch:
            patch.setattr(session.recorder, "write", lambda game: (tmp_path / "no" / "folder").touch())
            player.act(STAY, STAY, STAY, STAY)
        assert "Nothing is lost" in player.frame["problem"] and session.recorder.written == 0
        player.act(STAY, STAY, STAY, STAY)
        assert player.frame["over"] and not player.frame["problem"]
    assert load_icrl4aht(tmp_path / "record")[0].entry.episodes == session.recorder.written == 2


@pytest.mark.parametrize("error", [RuntimeError, ValueError])
def test_failure_of_an_agent_is_shown_and_logged(error, monkeypatch, caplog):
    steps: list[Any] = []

    def fail(chosen: Any) -> float:
        steps.append(chosen)
        raise error("no such layer")

    session = new_session()
    monkeypatch.setattr(session.game, "step", fail)
    with make_client(session) as client, open_browser(client) as player:
        player.act(STAY, STAY)
        assert player.frame["problem"].startswith("The game has stopped, because an agent failed: " + error.__name__)
        player.socket.send_json({"action": STAY})  # ignored, without an answer
        assert player.send(unknown=1)["kind"] == "problem"
    assert len(steps) == 1 and "no such layer" in caplog.text


def test_two_people_play_and_each_is_shown_as_agent_0():
    session = new_session("human")
    with make_client(session) as client, open_browser(client) as one:
        assert one.frame["missing"] == 1
        with open_browser(client) as two:
            assert (one.setup["slot"], two.setup["slot"]) == (0, 1)
            assert one.socket.receive_json()["missing"] == 0
            assert two.frame["record"][:2] == one.frame["record"][1::-1]
            with pytest.raises(starlette.WebSocketDisconnect) as closed, open_browser(client):
                pass
            assert closed.value.code == 4000
            assert one.send(action=STAY)["ready"]
            assert two.socket.receive_json()["waiting"], "the game waits until both people have pressed a key"
            assert not two.send(action=STAY)["waiting"]
            assert one.socket.receive_json()["clock"] == 0
            one.socket.send_json({"action": UP})
            assert two.send(action=DOWN)["clock"] == 1
            assert one.socket.receive_json()["clock"] == 1
        lost = one.socket.receive_json()
        assert (lost["missing"], lost["waiting"], lost["clock"]) == (1, True, 1)
        with open_browser(client, slot="1") as two:
            assert two.setup["slot"] == 1


def test_game_steps_at_a_fixed_rate_if_no_key_is_pressed():
    with make_client(new_session(episodes=1, steps=5, ticks=50)) as client, open_browser(client) as player:
        player.act(STAY)
        while not player.frame["over"]:
            player.frame = player.socket.receive_json()
        assert player.frame["clock"] == 5


def test_session_compares_the_person_with_reference_egos():
    session = new_session("H4/t0", compared=("stay", "oracle"), episodes=1, steps=100)
    session.compare(lambda: None)
    assert session.references["stay"] == [0.0]
    assert session.references["oracle"][0] > 0


def test_requests_from_other_websites_are_refused():
    with make_client(new_session()) as client:
        with (
            pytest.raises(starlette.WebSocketDisconnect),
            client.websocket_connect("ws://127.0.0.1/play", headers={"origin": "http://evil.example"}),
        ):
            pass
        assert client.get("/", headers={"host": "evil.example"}).status_code == 400


def test_play_command_rejects_invalid_options(tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").touch()
    record = ("--record", str(tmp_path / "new"))
    with open_port(0) as taken:
        port = taken.getsockname()[1]
        for words, message in (
            (("--with", "stay", "--port", port), f"port {port} of 127.0.0.1"),
            (("--record", tmp_path / "full"), "full: exists, expected a new folder; give another one"),
            (("--layout", "rooms-0-46", "--with", "H1/t0"), "test teammates play only published"),
            (("--with", "oracle", *record), "only test teammates"),
            (("--slot", "teammate", *record), "only the ego can be recorded"),
            (("--with", "H9/t9"), "unknown partner 'H9/t9'"),
        ):
            with pytest.raises(Icrl4ahtError, match=message):
                run_cli("play", *words)

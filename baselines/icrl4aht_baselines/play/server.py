"""Web server of `icrl4aht-data play`: a page and a websocket, on loopback only."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from string import Template
from threading import Thread
from typing import Any
from urllib.parse import urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from icrl4aht_baselines.play.game import HUMAN, Game, find_partner
from icrl4aht_baselines.play.recording import CONSENT, VIEWS, GameRecorder, check_pseudonym
from icrl4aht_data.browsing.drawings import add_drawings, layout_drawings
from icrl4aht_data.browsing.page import page_source, page_style
from icrl4aht_data.errors import Icrl4ahtError, OptionError
from icrl4aht_data.overcooked.actions import ACTIONS, EGO
from icrl4aht_data.overcooked.cells import BUTTON, INDICATOR, WINDOW
from icrl4aht_data.overcooked.layouts import Layout
from icrl4aht_data.overcooked.rules import DELIVERY_REWARD, PRESS_REWARD, WRONG_DELIVERY_REWARD
from icrl4aht_data.overcooked.state import POT_STEPS, swap_agents

HOST = "127.0.0.1"

SHOWN_EGOS = ("stay", "rl2-reference", "oracle")
"""Names of the egos that the page compares a person with."""

_ALL_CONNECTED = 4000  # websocket close code: everyone who plays is already connected


def how_to_play(layout: Layout) -> str:
    """Return text that explains the game to a person who has never played it."""
    board = "on the white board and " if INDICATOR in layout.kinds else ""
    button = f"press ? (this costs {-PRESS_REWARD:g}), " if BUTTON in layout.kinds else ""
    return (
        f"You are the blue chef: move with the arrow keys; space takes, puts down, cooks and serves what is in front "
        f"of you. Put the recipe's three ingredients into a pot, wait {POT_STEPS} steps, take the soup with a plate "
        f"and serve it at the green bell: {DELIVERY_REWARD:+g}, a wrong soup {WRONG_DELIVERY_REWARD:g}. The recipe is "
        f"{board}below the whole map. If you cannot see it, {button}watch what your partner cooks, or try a soup."
    )


class PlaySession:
    """Session of a game: the people who are connected to the game, and its recorder.

    The game waits before each episode, and after a lost connection, until everyone who plays presses a key.

    Args:
        game: game to play.
        partner: name of the partner, which the page shows.
        ticks: steps per second; with 0, a step is taken as soon as everyone has acted.
        recorder: recorder of the game; None for a game that is not recorded.
        compared: names of egos to compare the person with.
    """

    def __init__(
        self,
        game: Game,
        partner: str,
        ticks: float,
        recorder: GameRecorder | None = None,
        compared: tuple[str, ...] = SHOWN_EGOS,
    ) -> None:
        self.game, self.partner, self.ticks, self.recorder = game, partner, ticks, recorder
        self.compared = () if partner == HUMAN else compared
        self.references: dict[str, list[float]] = {}
        self._sockets: dict[int, WebSocket] = {}
        self._chosen: dict[int, int] = {}
        self._ready: set[int] = set()
        self._views = {VIEWS[0] if recorder else VIEWS[1]}  # views shown in this episode; `_view` is the current one
        self._view = next(iter(self._views))
        self._reward, self._problem, self._failed, self._moving = 0, "", False, asyncio.Event()
        start = [game.record, swap_agents(game.record)]
        self._layout = [layout_drawings(game.layout, record[None]) for record in start]

    # ---- messages to browsers

    def _setup_message(self, slot: int) -> dict[str, Any]:
        game, recorder = self.game, self.recorder
        return {
            "kind": "setup",
            "slot": slot,
            "layout": self._layout[slot],
            "name": game.layout.name,
            "partner": self.partner,
            "episodes": game.episodes,
            "steps": game.steps,
            "actions": ACTIONS,
            "view": self._view,
            "window": WINDOW,
            "consent": CONSENT if recorder and recorder.pseudonym is None else None,
            "compared": self.compared,
        }

    def _frame_message(self, slot: int) -> dict[str, Any]:
        game, layout = self.game, self._layout[slot]
        # Each person is shown as agent 0, the blue chef.
        record = game.record if slot == EGO else swap_agents(game.record)
        return {
            "kind": "frame",
            "record": record.tolist(),
            "drawings": add_drawings(game.layout, record[None], layout["drawings"]),
            "clock": game.clock,
            "earned": game.earned,
            "reward": self._reward,
            "returns": game.returns,
            "over": game.is_over,
            "waiting": not self._moving.is_set(),
            "ready": slot in self._ready,
            "missing": len(game.people) - len(self._sockets),
            "problem": self._problem,
            "recorded": str(self.recorder.folder) if self.recorder else None,
            "references": self.references,
        }

    async def show(self) -> None:
        """Send the current state to all connected browsers."""
        for slot, connection in list(self._sockets.items()):
            with suppress(RuntimeError, WebSocketDisconnect):  # the connection is closed, which `connect` handles
                await connection.send_json(self._frame_message(slot))

    # ---- steps of the game

    async def run(self) -> None:
        """Take steps at the session's rate until the game is over."""
        loop, due = asyncio.get_running_loop(), 0.0
        while not self.game.is_over:
            await self._moving.wait()
            due = max(due + 1 / self.ticks, loop.time())  # a late step delays all following steps
            await asyncio.sleep(due - loop.time())
            if self._moving.is_set():
                await self.advance()

    async def advance(self) -> None:
        """Take a step with the actions that people chose since the last step, and show the new state."""
        finished = len(self.game.returns)
        try:
            self._reward = self.game.step(self._chosen)
        except Exception as error:  # agents can be any code; without a message the page would only stop
            logging.getLogger(__name__).exception("an agent failed")
            self._problem, self._failed = f"The game has stopped, because an agent failed: {error!r}.", True
            self._pause()
            await self.show()
            return
        self._chosen = {}
        if len(self.game.returns) > finished:
            self._pause()
            await self.save()
        await self.show()
        self._reward = 0

    def _pause(self) -> None:
        self._moving.clear()
        self._ready.clear()
        self._chosen = {}

    async def save(self) -> None:
        """Write the finished episodes. A failure is shown on the page, and the next call tries again."""
        if self.recorder is None:
            return
        self.recorder.views.append(sorted(self._views))
        self._views, self._problem = {self._view}, ""
        try:
            await asyncio.to_thread(self.recorder.write, self.game)
        except (Icrl4ahtError, OSError) as error:
            self._problem = (
                f"The record was not written: {error}. Nothing is lost: writing is tried again after each episode."
            )

    def compare(self, changed: Callable[[], Any]) -> None:
        """Play the same episodes with egos instead of the person, which takes seconds for each ego.

        Args:
            changed: function that is called after each ego.
        """
        slot = self.game.people[0]
        for name in self.compared:
            returns: list[float] = []
            with suppress(Icrl4ahtError):  # a model that cannot play this layout has no returns
                players = list(self.game.players)
                players[slot] = find_partner(name, self.game.layout, slot).player
                returns = self.game.with_players(players).play()
            self.references = self.references | {name: returns}
            changed()

    # ---- messages from browsers

    async def connect(self, connection: WebSocket) -> None:
        """Serve a browser until its connection ends."""
        origin = connection.headers.get("origin")
        if origin and urlsplit(origin).netloc != connection.headers.get("host"):
            await connection.close(1008)  # the request comes from a page of another site
            return
        await connection.accept()
        wanted, free = connection.query_params.get("slot"), [x for x in self.game.people if x not in self._sockets]
        if not free:
            await connection.close(_ALL_CONNECTED)
            return
        slot = next((x for x in free if str(x) == wanted), free[0])
        self._sockets[slot] = connection
        try:
            await connection.send_json(self._setup_message(slot))
            await self.show()
            while True:
                await self._receive(slot, connection, await connection.receive_text())
        except (KeyError, RuntimeError, WebSocketDisconnect):
            pass  # the browser closed the connection, or sent bytes instead of text
        finally:
            del self._sockets[slot]
            self._pause()
            await self.show()

    async def _receive(self, slot: int, connection: WebSocket, text: str) -> None:
        try:
            message = json.loads(text)
            if (action := message.get("action")) in range(len(ACTIONS)):
                await self._act(slot, action)
            elif (view := message.get("view")) in VIEWS:
                self._view = view
                self._views.add(view)
            elif "pseudonym" in message and message.get("agrees") is True and self.recorder:
                self.recorder.pseudonym = self.recorder.pseudonym or check_pseudonym(message["pseudonym"])
                await connection.send_json(self._setup_message(slot))
                await self.show()
            else:
                raise OptionError(f"{text[:80]}: expected a message with an action, a view, or a pseudonym and consent")
        except (ValueError, TypeError, AttributeError, Icrl4ahtError) as error:
            await connection.send_json({"kind": "problem", "text": str(error)})

    async def _act(self, slot: int, action: int) -> None:
        """Store a person's action for the next step. While the game waits, any action marks the person as ready."""
        if self._failed or self.game.is_over or (self.recorder and self.recorder.pseudonym is None):
            return
        if not self._moving.is_set():
            self._ready.add(slot)
            if self._ready == set(self.game.people):
                self._moving.set()
            await self.show()
            return
        self._chosen[slot] = action
        if self.ticks == 0 and self._chosen.keys() == set(self.game.people):
            await self.advance()


def game_page(layout: Layout) -> str:
    """Return the HTML page of the game."""
    own = Path(__file__).parent
    text = {name: (own / f"page.{name}").read_text(encoding="utf-8") for name in ("html", "css", "js")}
    script = "\n".join([page_source("state.js"), page_source("curve.js"), text["js"]])
    style = f"{page_style()}\n{text['css']}"
    return Template(text["html"]).substitute(style=style, script=script, how_to=how_to_play(layout))


def make_app(session: PlaySession) -> Starlette:
    """Return the web application, which also runs the session's game."""

    async def page(request: Request) -> HTMLResponse:
        return HTMLResponse(game_page(session.game.layout), headers={"Cache-Control": "no-store"})

    @asynccontextmanager
    async def running(app: Starlette) -> AsyncIterator[None]:
        loop = asyncio.get_running_loop()

        def send_state() -> None:
            with suppress(RuntimeError):  # raised if the server has stopped
                asyncio.run_coroutine_threadsafe(session.show(), loop)

        Thread(target=session.compare, args=[send_state], daemon=True).start()
        task = asyncio.create_task(session.run()) if session.ticks else None
        yield
        if task:
            task.cancel()

    hosts = Middleware(TrustedHostMiddleware, allowed_hosts=[HOST, "localhost"])
    routes = [Route("/", page), WebSocketRoute("/play", session.connect)]
    return Starlette(routes=routes, middleware=[hosts], lifespan=running)


def open_port(port: int) -> socket.socket:
    """Return a listening socket on loopback; port 0 chooses any free port.

    Raises:
        OptionError: if the port is in use or not allowed.
    """
    try:
        return socket.create_server((HOST, port))
    except OSError as error:
        reason = os.strerror(error.errno or 0)
        raise OptionError(
            f"port {port} of {HOST}: {reason}; give another --port, or --port 0 for any free port"
        ) from error


def serve_session(session: PlaySession, listener: socket.socket) -> None:
    """Serve a session until the program is interrupted."""
    config = uvicorn.Config(make_app(session), log_level="warning", ws="websockets-sansio", timeout_graceful_shutdown=1)
    with suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[listener])

"""Faults of remotes: what servers and the lines to them do wrong."""

from __future__ import annotations

import logging
import shutil
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from email.utils import formatdate
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.remote import store as transport
from tests.robustness.faults.scene import Ordered, Scene, Target, Try, check, length
from tests.servers.common import (
    Cut,
    Etag,
    Flip,
    IgnoreRange,
    Long,
    Request,
    Short,
    Slow,
    Status,
    http_server,
    hub_server,
    s3_server,
)
from tests.servers.http import Answer, Server
from tests.servers.process import environment, forget_filesystems

ALWAYS = 10**9
ANY = ("GET", "HEAD")
BUSY = (500, 502, 503, 504)


@contextmanager
def on_http(scene: Scene, folder: Path | None = None) -> Iterator[Target]:
    with http_server(folder or scene.release) as server:
        yield Target(server.url, server.faults, server.log)


@contextmanager
def on_hub(scene: Scene) -> Iterator[Target]:
    with hub_server(scene.new()) as hub, _hurried():
        hub.add_repo("org/release", scene.release)
        yield Target("hf://datasets/org/release", hub.faults, hub.log)


@contextmanager
def _hurried() -> Iterator[None]:
    """The Hub's client has a patience of its own, 23 seconds a request."""
    from huggingface_hub import file_download
    from huggingface_hub.utils import _http
    from huggingface_hub.utils import logging as hub_logging

    said = hub_logging.get_verbosity()
    hub_logging.set_verbosity(logging.CRITICAL)
    hurried = SimpleNamespace(**vars(time) | {"sleep": lambda seconds: time.sleep(seconds / 500)})
    with patch.object(_http, "time", hurried), patch.object(file_download, "time", hurried):
        yield
    hub_logging.set_verbosity(said)


@contextmanager
def on_s3(scene: Scene) -> Iterator[Target]:
    """A bucket behind a server that may do wrong: moto's own cannot."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # moto tells of every request
    with s3_server(scene.release, "bucket") as bucket:
        server = Server(partial(_forward, bucket.endpoint))
        try:
            with environment({"AWS_ENDPOINT_URL": server.url, "AWS_ENDPOINT_URL_S3": server.url}):
                forget_filesystems("s3")
                yield Target(bucket.url, server.faults, server.log)
        finally:
            server.close()


def _forward(endpoint: str, request: Request, body: bytes) -> Answer:
    """The whole object, of which the server gives the range."""
    headers = {name: value for name, value in request.headers.items() if name not in ("Range", "Host")}
    asked = urllib.request.Request(endpoint + request.target, headers=headers)  # a GET for a HEAD, too
    try:
        with urllib.request.urlopen(asked) as answer:
            kept = {name: answer.headers[name] for name in ("Last-Modified", "Content-Type") if answer.headers[name]}
            return Answer(answer.read(), headers=kept, etag=answer.headers["ETag"])
    except urllib.error.HTTPError as error:
        return Answer(error.read(), error.code)


Place = Callable[[Scene], Any]


def cuts(scene: Scene, n: int, place: Place = on_http) -> Iterator[Try]:
    """A connection that is cut at a random byte, once or from then on; in downloads and in streams."""

    def order(share: float) -> Callable[[Request], Cut]:
        return lambda request: Cut(int(share * length(request)))

    yield from _anywhere(scene, n, place, lambda: order(scene.rng.random()))


def busy(scene: Scene, n: int, place: Place = on_http) -> Iterator[Try]:
    """Errors 5xx of any request: bursts shorter than our patience, or without end."""
    yield from _anywhere(
        scene, n, place, lambda: Status(int(scene.rng.choice(BUSY))), longest=3, methods=ANY, in_hub=False
    )


def flips(scene: Scene, n: int, place: Place = on_http) -> Iterator[Try]:
    """Bodies of the right length in which one bit is another."""

    def order() -> Flip:
        return Flip(int(scene.rng.integers(10**6)), 1 << int(scene.rng.integers(8)))

    yield from _anywhere(scene, n, place, order, in_hub=False)


def manifests(scene: Scene, n: int, place: Place = on_http) -> Iterator[Try]:
    """The same of the manifest, for which no hash vouches."""

    def attempt(target: Target, rule: Ordered, stream: bool, cached: bool) -> None:
        _forget(cached)
        scene.meet(target, rule, passing=False, stream=stream, hub=cached)

    with place(scene) as target:
        for number in range(n):
            flip = Flip(int(scene.rng.integers(10**6)), 1 << int(scene.rng.integers(8)))
            rule = Ordered(flip, path="*MANIFEST.sha256")
            cached = target.url.startswith("hf://") and number % 2 > 0
            yield partial(attempt, target, rule, number % 4 > 1, cached)


def lengths(scene: Scene, n: int) -> Iterator[Try]:
    """Bodies, or what is said of their length, that are a little or much too short or too long."""

    def order() -> Short | Long:
        by = int(scene.rng.choice([1, 7, 1000, 10**6]))
        return Short(by) if scene.rng.random() < 0.5 else Long(by)

    yield from _anywhere(scene, n, on_http, order, methods=ANY)


def no_ranges(scene: Scene, n: int) -> Iterator[Try]:
    """A server that gives the whole file whatever is asked for, once or always."""
    with on_http(scene) as target:
        for number in range(n):
            stream = number % 4 > 1
            rule = Ordered(IgnoreRange(), _some(scene, target, stream), ALWAYS if number % 2 else 1)
            yield partial(scene.meet, target, rule, passing=True, stream=stream)


def _some(scene: Scene, target: Target, stream: bool) -> int:
    """The number of one of the requests for a body."""
    return int(scene.rng.integers(scene.requests(target, ("GET",), stream)))


def _anywhere(
    scene: Scene,
    n: int,
    place: Place,
    order: Callable[[], Any],
    longest: int = 1,
    methods: tuple[str, ...] = ("GET",),
    in_hub: bool = True,
) -> Iterator[Try]:
    """A fault from a random request on: for at most `longest` requests, or for all that follow.

    `in_hub` says whether the Hub's own client retries after it.
    """
    with place(scene) as target:
        hub = target.url.startswith("hf://")
        kinds = [(False, False), (True, False), (False, True)] if hub else [(False, False), (True, False)]
        requests = {kind: scene.requests(target, methods, *kind) for kind in kinds if _forget(hub)}
        for number in range(n):
            stream, cached = kinds[number % len(kinds)]
            passing = number // len(kinds) % 2 == 0
            times = int(scene.rng.integers(1, longest + 1)) if passing else ALWAYS
            path = "*" if methods == ANY or not hub else "/[!a]*"  # the answers of /api have no hash
            rule = Ordered(order(), int(scene.rng.integers(requests[stream, cached])), times, path, methods)
            yield partial(_attempt, scene, target, rule, passing and (in_hub or not hub), stream, cached)


def _attempt(scene: Scene, target: Target, rule: Ordered, passing: bool, stream: bool, cached: bool) -> None:
    while not rule.hit:  # the Hub's client remembers some answers: there may be fewer requests than there were
        _forget(target.url.startswith("hf://"))
        rule.seen = 0
        scene.meet(target, rule, passing=passing, stream=stream, hub=cached)
        rule.first //= 2


def _forget(hub: bool) -> bool:
    """Empty the Hub's own cache."""
    if hub:
        from huggingface_hub import constants

        shutil.rmtree(constants.HF_HUB_CACHE, ignore_errors=True)
    return True


def too_many(scene: Scene, n: int) -> Iterator[Try]:
    """429 with Retry-After, seconds or a date: the same request comes again, but not before."""

    def attempt(target: Target, first: int, stream: bool, by_date: bool) -> None:
        def refuse(request: Request) -> Status:
            asked = formatdate(time.time() + 2, usegmt=True) if by_date else "1"  # whole seconds, cut
            return Status(429, {"Retry-After": asked})

        rule = Ordered(refuse, first)
        began = len(target.log)
        scene.meet(target, rule, passing=True, stream=stream)
        refused = rule.hit[0]
        key = refused.method, refused.path, refused.headers.get("Range")
        same = [r for r in target.log[began:] if (r.method, r.path, r.headers.get("Range")) == key]
        waited = same[same.index(refused) + 1].began - refused.began
        check(waited >= 0.9, f"asked again after {waited:.2f} s, not after 1 s")

    with on_http(scene) as target:
        for number in range(n):
            stream = number % 2 > 0
            yield partial(attempt, target, _some(scene, target, stream), stream, number % 3 > 1)


def slow(scene: Scene, n: int) -> Iterator[Try]:
    """Answers that come late, or a few bytes at a time, or not at all for longer than we wait."""

    def attempt(target: Target, rule: Ordered, passing: bool, stream: bool) -> None:
        with patch.object(transport, "_TIMEOUT", 0.4):
            scene.meet(target, rule, passing=passing, stream=stream)

    with on_http(scene) as target:
        for number in range(n):
            kind = number % 4
            fault = [Slow(0.2), Slow(0, 20_000), Slow(3), Slow(3)][kind]
            stream = bool(scene.rng.random() < 0.5)
            rule = Ordered(fault, _some(scene, target, stream), ALWAYS if kind == 3 else 3)
            yield partial(attempt, target, rule, kind < 3, stream)


def etags(scene: Scene, n: int) -> Iterator[Try]:
    """Files whose ETag changes between two requests, their content does not."""
    with on_http(scene) as target:
        for number in range(n):
            stream = number % 2 > 0
            rule = Ordered(lambda request: Etag(f"{len(target.log)}"), _some(scene, target, stream), ALWAYS)
            yield partial(scene.meet, target, rule, passing=True, stream=stream)


def versions(scene: Scene, n: int) -> Iterator[Try]:
    """Another version of the release takes the place of the one that is being read, for a while."""

    def attempt(first: int, stream: bool) -> None:
        served = scene.new()
        shutil.copytree(scene.release, served)

        def replace(request: Request) -> None:
            shutil.copytree(scene.other, served, dirs_exist_ok=True)

        use = scene.stream if stream else scene.download
        with on_http(scene, served) as target, scene.met() as to:
            target.faults.add(Ordered(replace, first))
            try:
                use(target.url, to)
            except Icrl4ahtError as error:
                scene.check_error(error)
                scene.check_arrived(to)
            target.faults.clear()
            shutil.copytree(scene.release, served, dirs_exist_ok=True)
            use(target.url, to)

    with on_http(scene) as target:
        places = [max(1, _some(scene, target, number % 2 > 0)) for number in range(n)]
    for number, first in enumerate(places):
        yield partial(attempt, first, number % 2 > 0)

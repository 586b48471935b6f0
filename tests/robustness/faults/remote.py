"""Faults of servers and connections."""

from __future__ import annotations

import logging
import shutil
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from email.utils import formatdate
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
from huggingface_hub import constants, file_download
from huggingface_hub.utils import _http
from huggingface_hub.utils import logging as hub_logging

from icrl4aht_data.errors import Icrl4ahtError
from icrl4aht_data.remote import store
from tests.robustness.faults.workspace import Attempt, FaultRule, Target, Workspace, body_length, check
from tests.servers.common import (
    Cut,
    Etag,
    Fault,
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


@contextmanager
def on_http(workspace: Workspace, folder: Path | None = None) -> Iterator[Target]:
    """Serve a folder, by default the release, over HTTP."""
    with http_server(folder or workspace.release) as server:
        yield Target(server.url, server.faults, server.log)


@contextmanager
def on_hub(workspace: Workspace) -> Iterator[Target]:
    """Serve the release as a dataset of the Hub, whose client waits 1/500 of its usual time between retries."""
    verbosity = hub_logging.get_verbosity()
    hub_logging.set_verbosity(logging.CRITICAL)
    hurried = SimpleNamespace(**vars(time) | {"sleep": lambda seconds: time.sleep(seconds / 500)})
    with hub_server(workspace.new_path()) as hub:
        hub.add_repo("org/release", workspace.release)
        with patch.object(_http, "time", hurried), patch.object(file_download, "time", hurried):
            yield Target("hf://datasets/org/release", hub.faults, hub.log)
    hub_logging.set_verbosity(verbosity)


@contextmanager
def on_s3(workspace: Workspace) -> Iterator[Target]:
    """Serve the release from a bucket, through a server that can inject faults, which moto's own cannot."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # moto logs every request
    with s3_server(workspace.release, "bucket") as bucket:
        server = Server(partial(_forward, bucket.endpoint))
        try:
            with environment({"AWS_ENDPOINT_URL": server.url, "AWS_ENDPOINT_URL_S3": server.url}):
                forget_filesystems("s3")
                yield Target(bucket.url, server.faults, server.log)
        finally:
            server.close()


def _forward(endpoint: str, request: Request, body: bytes) -> Answer:
    """Return the complete object, from which the server cuts the range."""
    headers = {name: value for name, value in request.headers.items() if name not in ("Range", "Host")}
    forwarded = urllib.request.Request(endpoint + request.target, headers=headers)  # a GET for a HEAD, too
    try:
        with urllib.request.urlopen(forwarded) as answer:
            kept = {name: answer.headers[name] for name in ("Last-Modified", "Content-Type") if answer.headers[name]}
            return Answer(answer.read(), headers=kept, etag=answer.headers["ETag"])
    except urllib.error.HTTPError as error:
        return Answer(error.read(), error.code)


Family = Callable[[Workspace, int], Iterator[Attempt]]
"""Yields n attempts."""
Serve = Callable[[Workspace], AbstractContextManager[Target]]
AnyFault = Fault | Callable[[Request], Fault | None]


def cut(rng: np.random.Generator) -> AnyFault:
    """A connection that is closed at a random byte of the body."""
    share = rng.random()
    return lambda request: Cut(int(share * body_length(request)))


def busy(rng: np.random.Generator) -> AnyFault:
    """One of the errors 5xx."""
    return Status(int(rng.choice((500, 502, 503, 504))))


def flip(rng: np.random.Generator) -> Flip:
    """A body of the right length with one inverted bit."""
    return Flip(int(rng.integers(10**6)), 1 << int(rng.integers(8)))


def wrong_length(rng: np.random.Generator) -> AnyFault:
    """A body, or its announced length, that is a little or much too short or too long."""
    by = int(rng.choice([1, 7, 1000, 10**6]))
    return Short(by) if rng.random() < 0.5 else Long(by)


def anywhere(
    make: Callable[[np.random.Generator], AnyFault],
    serve: Serve = on_http,
    longest: int = 1,
    methods: tuple[str, ...] = ("GET",),
    hub_retries: bool = True,
) -> Family:
    """Return the family of a fault from a random request on: for at most `longest` requests, or for all that follow.

    Args:
        make: makes a fault from random numbers.
        serve: the server.
        longest: most requests that meet a fault that passes.
        methods: HTTP methods that meet the fault.
        hub_retries: whether the Hub's client retries after the fault.
    """

    def family(workspace: Workspace, n: int) -> Iterator[Attempt]:
        with serve(workspace) as target:
            # download, stream, and on the Hub a download into the Hub's own cache
            uses = [(False, False), (True, False), (False, True)][: 3 if target.is_hub else 2]
            _empty_hub_cache(target.is_hub)
            requests = {use: workspace.count_requests(target, methods, *use) for use in uses}
            for number in range(n):
                use, succeeds = uses[number % len(uses)], number // len(uses) % 2 == 0
                times = int(workspace.rng.integers(1, longest + 1)) if succeeds else ALWAYS
                first = int(workspace.rng.integers(requests[use]))
                path = "/[!a]*" if target.is_hub and methods != ANY else "*"  # the answers of /api have no hash
                rule = FaultRule(make(workspace.rng), first, times, path, methods)
                yield partial(attempt, workspace, target, rule, succeeds and (hub_retries or not target.is_hub), *use)

    def attempt(
        workspace: Workspace, target: Target, rule: FaultRule, succeeds: bool, stream: bool, default_folder: bool
    ) -> None:
        while not rule.hit:  # the Hub's client caches some answers, so that there may be fewer requests than counted
            _empty_hub_cache(target.is_hub)
            rule.seen = 0
            workspace.use_with_fault(target, rule, succeeds=succeeds, stream=stream, default_folder=default_folder)
            rule.first //= 2

    return family


def _empty_hub_cache(hub: bool = True) -> None:
    if hub:
        shutil.rmtree(constants.HF_HUB_CACHE, ignore_errors=True)


def flipped_manifest(serve: Serve = on_http) -> Family:
    """Return the family of manifests with one inverted bit, which no hash protects."""

    def family(workspace: Workspace, n: int) -> Iterator[Attempt]:
        with serve(workspace) as target:
            for number in range(n):
                rule = FaultRule(flip(workspace.rng), path="*MANIFEST.sha256")
                yield partial(attempt, workspace, target, rule, number % 4 > 1, target.is_hub and number % 2 > 0)

    def attempt(workspace: Workspace, target: Target, rule: FaultRule, stream: bool, default_folder: bool) -> None:
        _empty_hub_cache(default_folder)
        workspace.use_with_fault(target, rule, succeeds=False, stream=stream, default_folder=default_folder)

    return family


def varied(*faults: tuple[AnyFault, float, bool], timeout: float = store._TIMEOUT) -> Family:
    """Return the family of given faults, each from a random request on, in downloads and in streams.

    Args:
        faults: fault, number of requests that meet it, whether the first attempt has to succeed.
        timeout: seconds that the client waits for an answer.
    """

    def family(workspace: Workspace, n: int) -> Iterator[Attempt]:
        with on_http(workspace) as target:
            for number in range(n):
                fault, times, succeeds = faults[number // 2 % len(faults)]
                stream = number % 2 > 0
                rule = FaultRule(fault, _random_request(workspace, target, stream), times)
                yield partial(attempt, workspace, target, rule, succeeds, stream)

    def attempt(workspace: Workspace, target: Target, rule: FaultRule, succeeds: bool, stream: bool) -> None:
        with patch.object(store, "_TIMEOUT", timeout):
            workspace.use_with_fault(target, rule, succeeds=succeeds, stream=stream)

    return family


def _random_request(workspace: Workspace, target: Target, stream: bool) -> int:
    """Return the number of one of the requests for a body."""
    return int(workspace.rng.integers(workspace.count_requests(target, stream=stream)))


slow = varied(
    (Slow(0.2), 3, True),
    (Slow(0, 20_000), 3, True),
    (Slow(3), 3, True),  # longer than the timeout
    (Slow(3), ALWAYS, False),
    timeout=0.4,
)
ignored_ranges = varied((IgnoreRange(), 1, True), (IgnoreRange(), ALWAYS, True))
changed_etags = varied((lambda request: Etag(f"{request.began}"), ALWAYS, True))


def too_many_requests(workspace: Workspace, n: int) -> Iterator[Attempt]:
    """429 with Retry-After as seconds or date: the request is repeated, but not earlier."""

    def attempt(target: Target, first: int, stream: bool, as_date: bool) -> None:
        def refuse(request: Request) -> Status:
            # a date has full seconds, so that two seconds ahead is more than one
            return Status(429, {"Retry-After": formatdate(time.time() + 2, usegmt=True) if as_date else "1"})

        rule = FaultRule(refuse, first)
        began = len(target.log)
        workspace.use_with_fault(target, rule, succeeds=True, stream=stream)
        refused = rule.hit[0]
        key = refused.method, refused.path, refused.headers.get("Range")
        same = [r for r in target.log[began:] if (r.method, r.path, r.headers.get("Range")) == key]
        waited = same[same.index(refused) + 1].began - refused.began
        check(waited >= 0.9, f"repeated after {waited:.2f} s, not after 1 s")

    with on_http(workspace) as target:
        for number in range(n):
            stream = number % 2 > 0
            yield partial(attempt, target, _random_request(workspace, target, stream), stream, number % 3 > 1)


def replaced_release(workspace: Workspace, n: int) -> Iterator[Attempt]:
    """Another release replaces the one that is being read, for a while."""

    def attempt(first: int, stream: bool) -> None:
        served = workspace.new_path()
        shutil.copytree(workspace.release, served)

        def replace(request: Request) -> None:
            shutil.copytree(workspace.other, served, dirs_exist_ok=True)

        use = workspace.stream if stream else workspace.download
        with on_http(workspace, served) as target, workspace.fresh_folders() as to:
            target.faults.add(FaultRule(replace, first))
            try:
                use(target.url, to)
            except Icrl4ahtError as error:
                workspace.check_error(error)
                workspace.check_files(to)
            target.faults.clear()
            shutil.copytree(workspace.release, served, dirs_exist_ok=True)
            use(target.url, to)

    with on_http(workspace) as target:
        firsts = [max(1, _random_request(workspace, target, number % 2 > 0)) for number in range(n)]
    for number, first in enumerate(firsts):
        yield partial(attempt, first, number % 2 > 0)

"""A simulated Hugging Face Hub on 127.0.0.1 for the real client: dataset repositories over HTTP and LFS."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import unquote, urlsplit

from tests.servers.faults import Faults, Request
from tests.servers.http import Answer, Server
from tests.servers.hub_repos import HubError, HubState, Repo, uses_lfs
from tests.servers.hub_routes import ROUTES, HubRequest
from tests.servers.process import hub_environment, hub_settings


class Hub(HubState):
    """A running test Hub; the environment variables in `environment` direct other processes to the Hub.

    A second server, the CDN, receives and serves large files by SHA-256. Its requests are in the same log, with the
    paths `/lfs/{sha256}` and `/cdn/{sha256}/{name}`, and the same faults apply.

    Args:
        root: empty folder for contents and for the client's caches.
    """

    def __init__(self, root: Path) -> None:
        super().__init__(root, token="hf_test")
        self.faults = Faults()
        self.log: list[Request] = []
        self._lock = threading.RLock()
        self._cdn = Server(self._serve_blob, self.faults, self.log)
        self._server = Server(self._serve, self.faults, self.log)
        self.endpoint, self.cdn = self._server.url, self._cdn.url
        self.environment = hub_environment(self.endpoint, root / "home", self.token)

    def add_repo(self, id: str, folder: Path, tag: str | None = None) -> str:
        """Commit the files of a folder to `main` of a new or existing repository; return the commit's hash."""
        with self._lock:
            repo, files = self.repos.setdefault(id, Repo(id)), {}
            for path in folder.rglob("*"):
                if path.is_file():
                    name = path.relative_to(folder).as_posix()
                    files[name] = self.blobs.add(path.read_bytes(), uses_lfs(name, path.stat().st_size))
            commit = repo.commit("main", files)
            if tag is not None:
                repo.tags[tag] = commit.oid
            return commit.oid

    def files(self, id: str, revision: str = "main") -> dict[str, bytes]:
        """Return the contents of all files of a revision, by path."""
        with self._lock:
            files = self.repo(id).resolve(revision).files
            return {path: self.blobs.path(file.sha256).read_bytes() for path, file in files.items()}

    def close(self) -> None:
        try:
            self._server.close()
        finally:
            self._cdn.close()

    def _serve(self, request: Request, body: bytes) -> Answer:
        path = urlsplit(request.target).path
        for methods, pattern, route in ROUTES:
            found = re.fullmatch(pattern, path)
            if found and request.method in methods.split():
                names = {name: unquote(text) for name, text in found.groupdict().items()}
                try:
                    with self._lock:
                        return route(HubRequest(self, request, names, body))
                except HubError as error:
                    return error.answer
        return HubError(404, "Sorry, we can't find the page you are looking for.").answer

    def _serve_blob(self, request: Request, body: bytes) -> Answer:
        sha256 = request.path.split("/")[2]
        if request.method == "PUT":
            with self._lock:
                self.blobs.add(body, lfs=True)
            return Answer()
        path = self.blobs.path(sha256)
        return Answer(path, headers={"ETag": f'"{sha256}"'}) if path.exists() else Answer(b"no such object\n", 404)


@contextmanager
def hub_server(root: Path) -> Iterator[Hub]:
    """Run an empty test Hub; within the context, huggingface_hub in this process connects to this Hub.

    Args:
        root: empty folder for contents and for the client's caches.
    """
    hub = Hub(root)
    try:
        with hub_settings(hub.environment):
            yield hub
    finally:
        hub.close()

"""A Hugging Face Hub on 127.0.0.1: what the client asks of it for datasets and models, by plain HTTP and LFS."""

from __future__ import annotations

import hashlib
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit

from tests.servers.faults import Faults, Request
from tests.servers.http import Answer, Server
from tests.servers.hub_repos import LFS_SUFFIXES, Blobs, Commit, Repo
from tests.servers.hub_routes import ROUTES, Call, Refusal
from tests.servers.process import hub_environment, hub_settings


class Hub:
    """`.endpoint`, `.log` and `.faults` of one hub; `.environment` sends another process to it.

    Large files come from a second port, the CDN, which takes and gives them by their SHA-256; its requests are in the
    same log, under `/cdn/{sha256}/{name}`, and its faults in the same rules. Files are large where their suffix says so
    or they have `lfs_size` bytes; trees are listed in pages of `page`.
    """

    def __init__(self, root: Path, faults: Faults | None = None) -> None:
        self.lfs_size, self.page, self.token = 10 << 20, 1000, "hf_test"
        self.faults = Faults() if faults is None else faults
        self.log: list[Request] = []
        self.blobs = Blobs(root / "blobs")
        self.repos: dict[tuple[str, str], Repo] = {}
        self._lock = threading.RLock()
        self._cdn = Server(self._serve_blob, self.faults, self.log)
        self._server = Server(self._serve, self.faults, self.log)
        self.endpoint, self.cdn = self._server.url, self._cdn.url
        self.environment = hub_environment(self.endpoint, root / "home", self.token)

    def add_repo(self, id: str, folder: Path, tag: str | None = None, kind: str = "dataset") -> str:
        """A commit that makes `main` the files of a folder, in a repo that may be new; its 40 hex digits."""
        with self._lock:
            repo, files = self.repos.setdefault((kind, id), Repo(kind, id)), {}
            for path in folder.rglob("*"):
                if path.is_file():
                    name = path.relative_to(folder).as_posix()
                    files[name] = self.blobs.add(path, self.is_large(name, path.stat().st_size))
            commit = repo.commit("main", files, f"Files of {folder.name}")
            if tag is not None:
                repo.tags[tag] = commit.oid
            return commit.oid

    def files(self, id: str, revision: str = "main", kind: str = "dataset") -> dict[str, bytes]:
        """What a revision holds."""
        with self._lock:
            files = self.commit(self.repo(id, kind), revision).files
            return {path: self.blobs.path(file.sha256).read_bytes() for path, file in files.items()}

    def close(self) -> None:
        try:
            self._server.close()
        finally:
            self._cdn.close()

    def _serve(self, request: Request, body: bytes) -> Answer:
        parts = urlsplit(request.target)
        for methods, pattern, route in ROUTES:
            found = re.fullmatch(pattern, parts.path)
            if found and request.method in methods.split():
                names = {name: unquote(text) for name, text in found.groupdict().items() if text is not None}
                call = Call(self, request, {"kind": "model", **names}, parse_qs(parts.query), body)
                try:
                    with self._lock:
                        return route(call)
                except Refusal as refusal:
                    return refusal.answer
        return Refusal(404, "Sorry, we can't find the page you are looking for.").answer

    def _serve_blob(self, request: Request, body: bytes) -> Answer:
        _, _, sha256, *_ = [*request.path.split("/"), "", ""]
        if re.fullmatch("[0-9a-f]{64}", sha256) is None:
            return Answer(b"no such object\n", 404)
        if request.method == "PUT":
            if hashlib.sha256(body).hexdigest() != sha256:
                return Answer(b"the content does not have the SHA-256 it was announced with\n", 400)
            with self._lock:
                self.blobs.add(body, lfs=True)
            return Answer()
        path = self.blobs.path(sha256)
        return Answer(path, etag=f'"{sha256}"') if path.exists() else Answer(b"no such object\n", 404)

    def is_large(self, path: str, size: int) -> bool:
        return size > 0 and (size >= self.lfs_size or Path(path).suffix in LFS_SUFFIXES)

    def repo(self, id: str, kind: str = "dataset") -> Repo:
        """Its branches, tags and commits."""
        if (kind, id) not in self.repos:
            raise Refusal(404, "Repository not found", "RepoNotFound")
        return self.repos[kind, id]

    def commit(self, repo: Repo, revision: str) -> Commit:
        commit = repo.resolve(revision)
        if commit is None:
            raise Refusal(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        return commit


@contextmanager
def hub_server(root: Path, faults: Faults | None = None) -> Iterator[Hub]:
    """A hub with nothing in it, which everything of huggingface_hub in this process talks to meanwhile.

    `root` is an empty folder for its files and the client's caches.
    """
    hub = Hub(root, faults)
    try:
        with hub_settings(hub.environment):
            yield hub
    finally:
        hub.close()

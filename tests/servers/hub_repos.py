"""State of the test Hub: dataset repositories, their commits and the contents of files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from tests.servers.http import Answer

LFS_SUFFIXES = (".7z", ".arrow", ".bin", ".bz2", ".ckpt", ".gif", ".gz", ".h5", ".jpeg", ".jpg", ".mp4", ".msgpack")
LFS_SUFFIXES += (".npy", ".npz", ".onnx", ".parquet", ".png", ".pt", ".pth", ".safetensors", ".tar", ".tgz", ".webp")
LFS_SUFFIXES += (".xz", ".zip", ".zst")
LFS_BYTES = 10 << 20  # files of at least this size are stored by LFS, whatever their suffix


class HubError(Exception):
    """Error that makes the test Hub answer a request with an error status.

    Args:
        status: HTTP status of the answer.
        message: text of the error.
        code: the Hub's name of the error; the client chooses the class of its exception by this name.
        headers: additional headers of the answer.
    """

    def __init__(self, status: int, message: str, code: str | None = None, headers: dict[str, str] | None = None):
        super().__init__(message)
        named = {"X-Error-Code": code} if code else {}
        self.answer = Answer(
            json.dumps({"error": message}).encode(),
            status,
            {"Content-Type": "application/json", "X-Error-Message": message} | named | (headers or {}),
        )


@dataclass(frozen=True)
class File:
    """A file in a commit of a repository.

    Args:
        sha256: SHA-256 of the file's content.
        size: number of bytes of the file's content.
        oid: git's hash of the content, or of the LFS pointer if the file is stored by LFS.
        lfs: whether the file is stored by LFS.
    """

    sha256: str
    size: int
    oid: str
    lfs: bool

    def entry(self, path: str) -> dict:
        """Return the file's entry in a listing of the repository."""
        entry: dict = {"type": "file", "oid": self.oid, "size": self.size, "path": path}
        pointer = {"oid": self.sha256, "size": self.size, "pointerSize": len(_lfs_pointer(self.sha256, self.size))}
        return entry | ({"lfs": pointer} if self.lfs else {})


@dataclass(frozen=True)
class Commit:
    """A commit of a repository: its hash, its creation time, and its files by path."""

    oid: str
    date: str
    files: Mapping[str, File]


@dataclass
class Repo:
    """A dataset repository, whose commits can be read by branch, tag or hash."""

    id: str
    private: bool = False
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    commits: dict[str, Commit] = field(default_factory=dict)

    def resolve(self, revision: str) -> Commit:
        """Return the commit that a revision names: a branch, a tag, or the hash of a commit."""
        commit = self.commits.get(self.branches.get(revision) or self.tags.get(revision) or revision)
        if commit is None:
            raise HubError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        return commit

    def commit(self, branch: str, files: Mapping[str, File]) -> Commit:
        """Add a commit that contains exactly the given files to a branch."""
        listed = {path: files[path] for path in sorted(files)}
        content = [self.id, {path: file.oid for path, file in listed.items()}, len(self.commits)]
        oid = hashlib.sha1(json.dumps(content).encode()).hexdigest()
        date = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.000Z")
        self.commits[oid] = commit = Commit(oid, date, listed)
        self.branches[branch] = oid
        return commit


class Blobs:
    """A folder that stores the contents of files by SHA-256."""

    def __init__(self, root: Path) -> None:
        self._root = root
        root.mkdir(parents=True)

    def path(self, sha256: str) -> Path:
        """Return the path of the content with a given SHA-256; the file exists only if the content is stored."""
        return self._root / sha256

    def add(self, data: bytes, lfs: bool) -> File:
        """Store the content of a file, and return the `File` to list in a commit."""
        sha256 = hashlib.sha256(data).hexdigest()
        if not self.path(sha256).exists():  # do not overwrite a file that a client may be downloading
            self.path(sha256).write_bytes(data)
        return self.file(sha256, lfs)

    def file(self, sha256: str, lfs: bool) -> File:
        """Return the `File` to list in a commit, for content that is already stored."""
        size = self.path(sha256).stat().st_size
        in_git = _lfs_pointer(sha256, size) if lfs else self.path(sha256).read_bytes()
        return File(sha256, size, hashlib.sha1(b"blob %d\0" % len(in_git) + in_git).hexdigest(), lfs)


def uses_lfs(path: str, size: int) -> bool:
    """Return whether the Hub stores a file by LFS, outside git."""
    return size > 0 and (size >= LFS_BYTES or Path(path).suffix in LFS_SUFFIXES)


def _lfs_pointer(sha256: str, size: int) -> bytes:
    return f"version https://git-lfs.github.com/spec/v1\noid sha256:{sha256}\nsize {size}\n".encode()


class HubState:
    """Repositories and file contents of a test Hub, and the addresses of its two servers.

    Args:
        root: empty folder in which file contents are stored.
        token: access token for writing, and for reading private repositories.
    """

    def __init__(self, root: Path, token: str) -> None:
        self.token = token
        self.blobs = Blobs(root / "blobs")
        self.repos: dict[str, Repo] = {}
        self.endpoint = self.cdn = ""

    def repo(self, id: str) -> Repo:
        """Return the repository with the id <org>/<repo>."""
        if id not in self.repos:
            raise HubError(404, "Repository not found", "RepoNotFound")
        return self.repos[id]

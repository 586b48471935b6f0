"""Repos with a history, and the files in them, as a hub keeps them."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

LFS_SUFFIXES = (".7z", ".arrow", ".bin", ".bz2", ".ckpt", ".gif", ".gz", ".h5", ".jpeg", ".jpg", ".mp4", ".msgpack")
LFS_SUFFIXES += (".npy", ".npz", ".onnx", ".parquet", ".png", ".pt", ".pth", ".safetensors", ".tar", ".tgz", ".webp")
LFS_SUFFIXES += (".xz", ".zip", ".zst")


@dataclass(frozen=True)
class File:
    """sha256 is of the content; oid is git's name of what git holds: the content, or the pointer to it."""

    sha256: str
    size: int
    oid: str
    lfs: bool

    def entry(self, path: str) -> dict:
        """As trees and paths-info list it."""
        entry: dict = {"type": "file", "oid": self.oid, "size": self.size, "path": path}
        return entry | ({"lfs": self.pointer() | {"oid": self.sha256}} if self.lfs else {})

    def sibling(self, path: str, blobs: bool) -> dict:
        """As a repo's information lists it."""
        if not blobs:
            return {"rfilename": path}
        sibling: dict = {"rfilename": path, "blobId": self.oid, "size": self.size}
        return sibling | ({"lfs": self.pointer() | {"sha256": self.sha256}} if self.lfs else {})

    def pointer(self) -> dict:
        return {"size": self.size, "pointerSize": len(_pointer(self.sha256, self.size))}


@dataclass(frozen=True)
class Commit:
    oid: str
    parent: str | None
    title: str
    date: str
    files: Mapping[str, File]

    def folders(self) -> set[str]:
        return {str(parent) for path in self.files for parent in Path(path).parents} - {"."}


@dataclass
class Repo:
    """kind is dataset or model. Every commit stays readable by its 40 hex digits."""

    kind: str
    id: str
    private: bool = False
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    commits: dict[str, Commit] = field(default_factory=dict)

    def resolve(self, revision: str) -> Commit | None:
        """A branch, a tag or a commit, short names or `refs/...`."""
        name = re.sub("^refs/(heads|tags)/", "", revision)
        return self.commits.get(self.branches.get(name) or self.tags.get(name) or revision)

    def commit(self, branch: str, files: Mapping[str, File], title: str) -> Commit:
        parent = self.branches.get(branch)
        listed = {path: files[path] for path in sorted(files)}
        content = [self.id, parent, title, {path: file.oid for path, file in listed.items()}, len(self.commits)]
        oid = hashlib.sha1(json.dumps(content).encode()).hexdigest()
        date = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.000Z")
        self.commits[oid] = commit = Commit(oid, parent, title, date, listed)
        self.branches[branch] = oid
        return commit

    def history(self, commit: Commit) -> list[Commit]:
        """Latest first."""
        found = [commit]
        while found[-1].parent is not None:
            found.append(self.commits[found[-1].parent])
        return found

    def last_change(self, commit: Commit, path: str) -> Commit:
        """The commit that gave a file, or a folder, what it has here."""
        content = _below(commit, path)
        last = commit
        for older in self.history(commit)[1:]:
            if _below(older, path) != content:
                break
            last = older
        return last


class Blobs:
    """Contents by SHA-256, in a folder."""

    def __init__(self, root: Path) -> None:
        self._root = root
        root.mkdir(parents=True)

    def path(self, sha256: str) -> Path:
        return self._root / sha256

    def add(self, data: bytes | Path, lfs: bool) -> File:
        """Keeps a copy; what the caller does to the original later changes nothing."""
        if isinstance(data, Path):
            with data.open("rb") as file:
                sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        else:
            sha256 = hashlib.sha256(data).hexdigest()
        if not self.path(sha256).exists():  # it may be on its way to a client
            if isinstance(data, Path):
                shutil.copyfile(data, self.path(sha256))
            else:
                self.path(sha256).write_bytes(data)
        return self.file(sha256, lfs)

    def file(self, sha256: str, lfs: bool) -> File:
        size = self.path(sha256).stat().st_size
        held = _pointer(sha256, size) if lfs else self.path(sha256).read_bytes()
        return File(sha256, size, hashlib.sha1(b"blob %d\0" % len(held) + held).hexdigest(), lfs)


def _pointer(sha256: str, size: int) -> bytes:
    return f"version https://git-lfs.github.com/spec/v1\noid sha256:{sha256}\nsize {size}\n".encode()


def _below(commit: Commit, path: str) -> dict[str, File]:
    return {name: file for name, file in commit.files.items() if name == path or name.startswith(f"{path}/")}

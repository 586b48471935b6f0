"""Functions that answer the requests to the test Hub, one function for each kind of request."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import quote

from tests.servers.faults import Request
from tests.servers.http import Answer
from tests.servers.hub_repos import LFS_SUFFIXES, File, HubError, HubState, Repo, uses_lfs

REPO = r"/api/datasets/(?P<id>[^/]+/[^/]+)"
AT = r"/(?P<revision>[^/]+)"
WEB = r"/datasets/(?P<id>[^/]+/[^/]+)"


@dataclass(frozen=True)
class HubRequest:
    """A request to the test Hub, with the state of the Hub, the named parts of the path, and the body."""

    hub: HubState
    request: Request
    names: dict[str, str]
    body: bytes

    @property
    def authorized(self) -> bool:
        """Whether the request contains the access token."""
        return self.request.headers.get("Authorization") == f"Bearer {self.hub.token}"

    @property
    def repo(self) -> Repo:
        """The repository named in the path; requests without the token do not find private repositories."""
        repo = self.hub.repo(self.names["id"])
        if repo.private and not self.authorized:
            raise HubError(401, "Repository not found", "RepoNotFound")
        return repo

    @property
    def url(self) -> str:
        return f"{self.hub.endpoint}/datasets/{self.names['id']}"

    def json(self) -> Any:
        return json.loads(self.body or b"{}")

    def require_token(self) -> None:
        if not self.authorized:
            raise HubError(401, "Invalid username or password.")


Route = Callable[[HubRequest], Answer]


def json_answer(data: Any, status: int = 200, **headers: str) -> Answer:
    return Answer(json.dumps(data).encode(), status, {"Content-Type": "application/json", **headers})


def repo_info(call: HubRequest) -> Answer:
    repo = call.repo
    commit = repo.resolve(call.names.get("revision", "main"))
    data = {"_id": "0" * 24, "id": repo.id, "author": repo.id.split("/")[0], "sha": commit.oid, "gated": False}
    data |= {"lastModified": commit.date, "private": repo.private, "disabled": False, "downloads": 0, "likes": 0}
    siblings = [{"rfilename": path, "size": file.size} for path, file in commit.files.items()]
    return json_answer(data | {"tags": [], "siblings": siblings})


def list_files(call: HubRequest) -> Answer:
    """Answer with all files and folders, at all depths."""
    files = call.repo.resolve(call.names["revision"]).files
    parents = {str(parent) for path in files for parent in PurePosixPath(path).parents} - {"."}
    folders = [{"type": "directory", "oid": "0" * 40, "size": 0, "path": parent} for parent in sorted(parents)]
    return json_answer([*folders, *(file.entry(path) for path, file in files.items())])


def list_refs(call: HubRequest) -> Answer:
    def named_refs(folder: str, names: dict[str, str]) -> list[dict]:
        return [{"name": name, "ref": f"refs/{folder}/{name}", "targetCommit": oid} for name, oid in names.items()]

    repo = call.repo
    data = {"branches": named_refs("heads", repo.branches), "tags": named_refs("tags", repo.tags), "converts": []}
    return json_answer(data | {"pullRequests": []})


def resolve(call: HubRequest) -> Answer:
    """Answer with the content of a file, or with a redirect to the CDN if the file is stored by LFS."""
    commit, path = call.repo.resolve(call.names["revision"]), call.names["path"]
    headers = {"X-Repo-Commit": commit.oid}
    if path not in commit.files:
        raise HubError(404, "Entry not found", "EntryNotFound", headers)
    file = commit.files[path]
    if not file.lfs:
        return Answer(call.hub.blobs.path(file.sha256), headers=headers | {"ETag": f'"{file.oid}"'})
    name = quote(path.rsplit("/", 1)[-1])
    headers |= {
        "X-Linked-Etag": f'"{file.sha256}"',
        "X-Linked-Size": str(file.size),
        "Location": f"{call.hub.cdn}/cdn/{file.sha256}/{name}?Signature=none",
    }
    return Answer(b"Found. Redirecting\n", 302, headers)


def create_repo(call: HubRequest) -> Answer:
    call.require_token()
    wanted = call.json()
    id = f"{wanted['organization']}/{wanted['name']}"
    url = f"{call.hub.endpoint}/datasets/{id}"
    if id in call.hub.repos:
        return json_answer({"error": "You already created this dataset repo", "url": url}, 409)
    repo = Repo(id, bool(wanted.get("private")) or wanted.get("visibility") == "private")
    attributes = "".join(f"*{suffix} filter=lfs diff=lfs merge=lfs -text\n" for suffix in sorted(LFS_SUFFIXES))
    repo.commit("main", {".gitattributes": call.hub.blobs.add(attributes.encode(), lfs=False)})
    call.hub.repos[id] = repo
    return json_answer({"url": url, "name": id, "id": repo.id})


def preupload(call: HubRequest) -> Answer:
    """Answer with the upload mode of each announced file, and with the hash of any existing file at the same path."""
    call.require_token()
    commit, listed = call.repo.resolve(call.names["revision"]), []
    for announced in call.json()["files"]:
        path = announced["path"]
        mode = "lfs" if uses_lfs(path, announced["size"]) else "regular"
        file = {"path": path, "shouldIgnore": False, "uploadMode": mode}
        if path in commit.files:
            known = commit.files[path]
            file["oid"] = known.sha256 if known.lfs else known.oid
        listed.append(file)
    return json_answer({"files": listed, "commitOid": commit.oid})


def lfs_batch(call: HubRequest) -> Answer:
    """Answer with upload addresses for the large files that the CDN does not store yet."""
    call.require_token()
    objects = []
    for announced in call.json()["objects"]:
        entry: dict = {"oid": announced["oid"], "size": announced["size"]}
        if not call.hub.blobs.path(announced["oid"]).exists():
            entry["actions"] = {"upload": {"href": f"{call.hub.cdn}/lfs/{announced['oid']}"}}
        objects.append(entry)
    return json_answer({"transfer": "basic", "objects": objects})


def commit(call: HubRequest) -> Answer:
    call.require_token()
    repo, branch = call.repo, call.names["revision"]
    head = repo.resolve(branch)
    files = dict(head.files)
    for line in call.body.splitlines():
        operation = json.loads(line)
        if operation["key"] == "header":
            if not head.oid.startswith(operation["value"].get("parentCommit") or ""):
                raise HubError(412, "A commit has happened since. Please refresh and try again.")
        else:
            _apply_operation(call.hub, files, operation["key"], operation["value"])
    oid = repo.commit(branch, files).oid
    return json_answer({"success": True, "commitOid": oid, "commitUrl": f"{call.url}/commit/{oid}", "hookOutput": ""})


def _apply_operation(hub: HubState, files: dict[str, File], key: str, value: dict) -> None:
    """Apply an operation, "file", "lfsFile" or "deletedFile", of a commit request to the files of the new commit."""
    path = value["path"].strip("/")
    if key == "file":
        content = base64.b64decode(value["content"], validate=True)
        files[path] = hub.blobs.add(content, lfs=False)
    elif key == "lfsFile":
        files[path] = hub.blobs.file(value["oid"], lfs=True)  # raises an error if the content was not uploaded
    else:
        del files[path]


def new_tag(call: HubRequest) -> Answer:
    call.require_token()
    repo, name = call.repo, call.json()["tag"]
    if name in repo.tags:
        raise HubError(409, f"Reference already exists: {name}")
    repo.tags[name] = repo.resolve(call.names["revision"]).oid
    return json_answer({})


def validate_yaml(call: HubRequest) -> Answer:
    """Accept every dataset card with the Hub's answer for valid cards."""
    return json_answer({"errors": [], "warnings": []})


ROUTES: list[tuple[str, str, Route]] = [
    ("POST", "/api/validate-yaml", validate_yaml),
    ("POST", "/api/repos/create", create_repo),
    ("GET", REPO, repo_info),
    ("GET", f"{REPO}/revision{AT}", repo_info),
    ("GET", f"{REPO}/tree{AT}/?", list_files),
    ("GET", f"{REPO}/refs", list_refs),
    ("POST", f"{REPO}/preupload{AT}", preupload),
    ("POST", f"{REPO}/commit{AT}", commit),
    ("POST", f"{REPO}/tag{AT}", new_tag),
    ("POST", rf"{WEB}\.git/info/lfs/objects/batch", lfs_batch),
    ("GET HEAD", f"{WEB}/resolve{AT}/(?P<path>.+)", resolve),
]
"""HTTP methods, pattern of the path, and function that answers, for each kind of request."""

"""The requests that a hub answers, one function each."""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, quote, urlencode, urlsplit

import yaml

from tests.servers.faults import Request
from tests.servers.http import Answer
from tests.servers.hub_card import card_errors, metadata
from tests.servers.hub_repos import LFS_SUFFIXES, Commit, File, Repo

if TYPE_CHECKING:
    from tests.servers.hub import Hub

USER = "tester"
REPO = r"/api/(?P<kind>dataset|model)s/(?P<id>[^/]+/[^/]+)"
AT = r"/(?P<revision>[^/]+)"
WEB = r"(?:/(?P<kind>dataset)s)?/(?P<id>[^/]+/[^/]+)"


class Refusal(Exception):
    """An answer that is an error: status, the Hub's code for it, message."""

    def __init__(self, status: int, message: str, code: str | None = None, headers: dict[str, str] | None = None):
        super().__init__(message)
        named = {"X-Error-Code": code} if code else {}
        self.answer = Answer(
            json.dumps({"error": message}).encode(),
            status,
            {"Content-Type": "application/json", "X-Error-Message": message} | named | (headers or {}),
        )


class Call:
    """One request to the hub: the names in its path, its query, its body, and what they stand for."""

    def __init__(self, hub: Hub, request: Request, names: dict[str, str], query: dict[str, list[str]], body: bytes):
        self.hub, self.request, self.names, self.query, self.body = hub, request, names, query, body

    @property
    def known(self) -> bool:
        """Whether it comes with the token."""
        return self.request.headers.get("Authorization") == f"Bearer {self.hub.token}"

    @property
    def repo(self) -> Repo:
        """The repo in its path; one that is private is not there without the token."""
        repo = self.hub.repo(self.names["id"], self.names["kind"])
        if repo.private and not self.known:
            raise Refusal(401, "Repository not found", "RepoNotFound")
        return repo

    @property
    def commit(self) -> Commit:
        return self.hub.commit(self.repo, self.names.get("revision", "main"))

    @property
    def url(self) -> str:
        return web_url(self.hub, self.names["kind"], self.names["id"])

    def json(self) -> Any:
        return json.loads(self.body or b"{}")

    def must_be_known(self) -> None:
        if not self.known:
            raise Refusal(401, "Invalid username or password.")


Route = Callable[[Call], Answer]


def web_url(hub: Hub, kind: str, id: str) -> str:
    return f"{hub.endpoint}/{'datasets/' if kind == 'dataset' else ''}{id}"


def answer(data: Any, status: int = 200, **headers: str) -> Answer:
    return Answer(json.dumps(data).encode(), status, {"Content-Type": "application/json", **headers})


def whoami(call: Call) -> Answer:
    call.must_be_known()
    access = {"accessToken": {"displayName": "test", "role": "write"}, "type": "access_token"}
    return answer({"type": "user", "name": USER, "fullname": USER, "orgs": [], "auth": access})


def info(call: Call) -> Answer:
    repo, commit = call.repo, call.commit
    card = _card(call.hub, commit)
    fields = ("license", "language", "size_categories", "task_categories")
    listed = {name: card.get(name) or [] for name in fields}
    tags = [f"{k}:{v}" for k, values in listed.items() for v in (values if isinstance(values, list) else [values])]
    data = {
        "_id": hashlib.sha1(repo.id.encode()).hexdigest()[:24],
        "id": repo.id,
        "author": repo.id.split("/")[0],
        "sha": commit.oid,
        "createdAt": repo.history(commit)[-1].date,
        "lastModified": commit.date,
        "private": repo.private,
        "gated": False,
        "disabled": False,
        "downloads": 0,
        "likes": 0,
        "tags": tags + list(card.get("tags") or []),
        "cardData": card,
        "siblings": [file.sibling(path, "blobs" in call.query) for path, file in commit.files.items()],
    }
    return answer(data | ({"modelId": repo.id} if repo.kind == "model" else {}))


def _card(hub: Hub, commit: Commit) -> dict[str, Any]:
    if "README.md" not in commit.files:
        return {}
    try:
        return metadata(hub.blobs.path(commit.files["README.md"].sha256).read_text("utf-8")) or {}
    except (yaml.YAMLError, UnicodeDecodeError):  # a repo that `add_repo` made from anything
        return {}


def tree(call: Call) -> Answer:
    commit, top = call.commit, call.names.get("path", "").strip("/")
    if top and top not in commit.folders():
        raise Refusal(404, f"{top} does not exist on {call.names['revision']!r}", "EntryNotFound")
    prefix = f"{top}/" if top else ""
    deep = _flag(call.query, "recursive")
    paths = sorted(
        path
        for path in commit.folders() | set(commit.files)
        if path.startswith(prefix) and (deep or "/" not in path[len(prefix) :])
    )
    size = int(call.query.get("limit", [str(call.hub.page)])[0])
    start = int(call.query.get("cursor", ["0"])[0])
    headers = {}
    if start + size < len(paths):
        query = urlencode({**call.query, "cursor": [start + size]}, doseq=True)
        headers["Link"] = f'<{call.hub.endpoint}{urlsplit(call.request.target).path}?{query}>; rel="next"'
    return answer(_entries(call, commit, paths[start : start + size], call.query), **headers)


def paths_info(call: Call) -> Answer:
    asked = parse_qs(call.body.decode())
    commit = call.commit
    known = commit.folders() | set(commit.files)
    paths = [path.strip("/") for path in asked.get("paths", [])]
    return answer(_entries(call, commit, [path for path in paths if path in known], asked))


def _flag(query: dict[str, list[str]], name: str) -> bool:
    return query.get(name, ["false"])[0].lower() in ("true", "1")


def _entries(call: Call, commit: Commit, paths: list[str], asked: dict[str, list[str]]) -> list[dict]:
    entries = []
    for path in paths:
        if path in commit.files:
            entry = commit.files[path].entry(path)
        else:
            content = {name: file.oid for name, file in commit.files.items() if name.startswith(f"{path}/")}
            oid = hashlib.sha1(json.dumps(content).encode()).hexdigest()
            entry = {"type": "directory", "oid": oid, "size": 0, "path": path}
        if _flag(asked, "expand"):
            last = call.repo.last_change(commit, path)
            entry["lastCommit"] = {"id": last.oid, "title": last.title, "date": last.date}
        entries.append(entry)
    return entries


def refs(call: Call) -> Answer:
    def listed(folder: str, names: dict[str, str]) -> list[dict]:
        return [{"name": name, "ref": f"refs/{folder}/{name}", "targetCommit": oid} for name, oid in names.items()]

    repo = call.repo
    data = {"branches": listed("heads", repo.branches), "tags": listed("tags", repo.tags), "converts": []}
    return answer(data | {"pullRequests": []})


def commits(call: Call) -> Answer:
    found = [
        {"id": commit.oid, "title": commit.title, "message": "", "date": commit.date, "authors": [{"user": USER}]}
        for commit in call.repo.history(call.commit)
    ]
    return answer(found)


def resolve(call: Call) -> Answer:
    commit, path = call.commit, call.names["path"]
    headers = {"X-Repo-Commit": commit.oid}
    if path not in commit.files:
        raise Refusal(404, "Entry not found", "EntryNotFound", headers)
    file = commit.files[path]
    if not file.lfs:
        return Answer(call.hub.blobs.path(file.sha256), headers=headers, etag=f'"{file.oid}"')
    name = quote(path.rsplit("/", 1)[-1])
    headers |= {
        "X-Linked-Etag": f'"{file.sha256}"',
        "X-Linked-Size": str(file.size),
        "Location": f"{call.hub.cdn}/cdn/{file.sha256}/{name}?Signature=none",
    }
    return Answer(b"Found. Redirecting\n", 302, headers)


def create(call: Call) -> Answer:
    call.must_be_known()
    asked = call.json()
    kind, id = asked.get("type") or "model", f"{asked.get('organization') or USER}/{asked['name']}"
    url = web_url(call.hub, kind, id)
    if kind not in ("dataset", "model"):
        raise Refusal(400, f"no {kind}s here")
    if (kind, id) in call.hub.repos:
        return answer({"error": f"You already created this {kind} repo", "url": url}, 409)
    repo = Repo(kind, id, bool(asked.get("private")) or asked.get("visibility") == "private")
    attributes = "".join(f"*{suffix} filter=lfs diff=lfs merge=lfs -text\n" for suffix in sorted(LFS_SUFFIXES))
    repo.commit("main", {".gitattributes": call.hub.blobs.add(attributes.encode(), lfs=False)}, "initial commit")
    call.hub.repos[kind, id] = repo
    return answer({"url": url, "name": id, "id": repo.id})


def delete(call: Call) -> Answer:
    call.must_be_known()
    asked = call.json()
    id = f"{asked.get('organization') or USER}/{asked['name']}"
    call.hub.repo(id, asked.get("type") or "model")
    del call.hub.repos[asked.get("type") or "model", id]
    return answer({})


def preupload(call: Call) -> Answer:
    call.must_be_known()
    there, found = call.commit.files, []
    for asked in call.json()["files"]:
        path = asked["path"]
        file = {"path": path, "shouldIgnore": False}
        file["uploadMode"] = "lfs" if call.hub.is_large(path, asked["size"]) else "regular"
        if path in there:
            file["oid"] = there[path].sha256 if there[path].lfs else there[path].oid
        found.append(file)
    return answer({"files": found, "commitOid": call.commit.oid})


def lfs_batch(call: Call) -> Answer:
    call.must_be_known()
    objects, verify = [], f"{call.hub.endpoint}{urlsplit(call.request.target).path.removesuffix('batch')}verify"
    _ = call.repo
    for asked in call.json()["objects"]:
        entry: dict = {"oid": asked["oid"], "size": asked["size"]}
        if not call.hub.blobs.path(asked["oid"]).exists():
            upload = {"href": f"{call.hub.cdn}/lfs/{asked['oid']}"}
            entry["actions"] = {"upload": upload, "verify": {"href": verify}}
        objects.append(entry)
    return answer({"transfer": "basic", "objects": objects})


def lfs_verify(call: Call) -> Answer:
    call.must_be_known()
    asked = call.json()
    path = call.hub.blobs.path(asked["oid"])
    if not path.exists() or path.stat().st_size != asked["size"]:
        raise Refusal(404, f"object {asked['oid']} of {asked['size']} bytes was not uploaded")
    return answer({})


def commit(call: Call) -> Answer:
    call.must_be_known()
    repo, branch = call.repo, call.names["revision"]
    if "create_pr" in call.query:
        raise Refusal(400, "no pull requests here")
    if branch not in repo.branches:
        raise Refusal(404, f"Invalid rev id: {branch}", "RevisionNotFound")
    head = repo.commits[repo.branches[branch]]
    title, files = "", dict(head.files)
    for line in call.body.splitlines():
        operation = json.loads(line)
        if operation["key"] == "header":
            title = operation["value"]["summary"]
            if not head.oid.startswith(operation["value"].get("parentCommit") or ""):
                raise Refusal(412, "A commit has happened since. Please refresh and try again.")
        else:
            _apply(call.hub, files, operation["key"], operation["value"])
    new = repo.commit(branch, files, title)
    url = f"{call.url}/commit/{new.oid}"
    return answer({"success": True, "commitOid": new.oid, "commitUrl": url, "hookOutput": ""})


def _apply(hub: Hub, files: dict[str, File], key: str, value: dict) -> None:
    path = value["path"].strip("/")
    if key == "file":
        try:
            content = base64.b64decode(value["content"], validate=True)
        except binascii.Error as error:
            raise Refusal(400, f"{path}: {error}") from None
        errors = card_errors(content.decode(errors="replace"))[0] if path == "README.md" else []
        if errors:
            raise Refusal(400, f"Invalid metadata in README.md: {'; '.join(errors)}")
        files[path] = hub.blobs.add(content, lfs=False)
    elif key == "lfsFile":
        if not hub.blobs.path(value["oid"]).exists():
            raise Refusal(400, f"{path}: its content {value['oid']} was not uploaded")
        files[path] = hub.blobs.file(value["oid"], lfs=True)
    elif key in ("deletedFile", "deletedFolder"):
        gone = [name for name in files if name == path or (key == "deletedFolder" and name.startswith(f"{path}/"))]
        if not gone:
            raise Refusal(404, f"A file with this name doesn't exist: {path}", "EntryNotFound")
        for name in gone:
            del files[name]
    else:
        raise Refusal(400, f"{key}: not known here")


def new_reference(call: Call) -> Answer:
    """A tag of the revision in the path, or a branch that the path names."""
    call.must_be_known()
    repo, asked = call.repo, call.json()
    tag = call.names["what"] == "tag"
    name = asked["tag"] if tag else call.names["revision"]
    names = repo.tags if tag else repo.branches
    if name in names:
        raise Refusal(409, f"Reference already exists: {name}")
    names[name] = call.hub.commit(repo, call.names["revision"] if tag else asked.get("startingPoint", "main")).oid
    return answer({})


def delete_reference(call: Call) -> Answer:
    call.must_be_known()
    names = call.repo.tags if call.names["what"] == "tag" else call.repo.branches
    if names.pop(call.names["revision"], None) is None:
        raise Refusal(404, f"Invalid rev id: {call.names['revision']}", "RevisionNotFound")
    return answer({})


def validate_yaml(call: Call) -> Answer:
    errors, warnings = card_errors(call.json()["content"])
    status = 400 if errors else 200
    if call.request.headers.get("Accept") == "text/plain":
        lines = "".join(f"- Error: {error}\n" for error in errors)
        return Answer(lines.encode(), status, {"Content-Type": "text/plain"})
    messages = {"errors": errors, "warnings": warnings}
    return answer({name: [{"message": text} for text in texts] for name, texts in messages.items()}, status)


ROUTES: list[tuple[str, str, Route]] = [
    ("GET", "/api/whoami-v2", whoami),
    ("POST", "/api/validate-yaml", validate_yaml),
    ("POST", "/api/repos/create", create),
    ("DELETE", "/api/repos/delete", delete),
    ("GET", REPO, info),
    ("GET", f"{REPO}/revision{AT}", info),
    ("GET", f"{REPO}/tree{AT}(?:/(?P<path>.*))?", tree),
    ("POST", f"{REPO}/paths-info{AT}", paths_info),
    ("GET", f"{REPO}/refs", refs),
    ("GET", f"{REPO}/commits{AT}", commits),
    ("POST", f"{REPO}/preupload{AT}", preupload),
    ("POST", f"{REPO}/commit{AT}", commit),
    ("POST", f"{REPO}/(?P<what>tag|branch){AT}", new_reference),
    ("DELETE", f"{REPO}/(?P<what>tag|branch){AT}", delete_reference),
    ("POST", rf"{WEB}\.git/info/lfs/objects/batch", lfs_batch),
    ("POST", rf"{WEB}\.git/info/lfs/objects/verify", lfs_verify),
    ("GET HEAD", f"{WEB}/resolve{AT}/(?P<path>.+)", resolve),
]

"""Upload of a release folder to a dataset repository of the Hugging Face Hub, compared afterwards and tagged."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from icrl4aht_data.checking.report import NamedProgress
from icrl4aht_data.errors import Icrl4ahtError, OptionError, UploadError
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.format.schema import MANIFEST
from icrl4aht_data.publishing.build import check_valid
from icrl4aht_data.utils.hashes import file_hash, git_hash

if TYPE_CHECKING:
    from huggingface_hub import HfApi
    from huggingface_hub.hf_api import RepoFile

_HUB_FILE = ".gitattributes"  # the Hub adds it to every repository
_KIND = "dataset"


class _File(NamedTuple):
    """Size in bytes and SHA-256, hexadecimal, of a file of the release."""

    size: int
    sha256: str


@dataclass(frozen=True)
class Upload:
    """The result, or the plan, of `upload_release`.

    Args:
        repo: ORG/REPO.
        tag: the data version's tag.
        url: address of the repository's page.
        files: path -> bytes, of the complete release.
        done: "already there" if the tag has this content; otherwise "uploaded", or "nothing" in a dry run.
        creates: whether the repository is new.
        private: whether a private repository was requested.
        deletes: files of another version, which are removed from the repository.
        commit: the tagged commit; None in a dry run.
    """

    repo: str
    tag: str
    url: str
    files: dict[str, int]
    done: Literal["already there", "uploaded", "nothing"] = "nothing"
    creates: bool = False
    private: bool = False
    deletes: list[str] = field(default_factory=list)
    commit: str | None = None

    def to_json(self) -> dict[str, Any]:
        return asdict(self) | {"bytes": sum(self.files.values())}

    def in_words(self) -> list[str]:
        """Return lines for people: in a dry run every file, otherwise a summary."""
        total = f"{len(self.files)} files, {sum(self.files.values()):,} bytes"
        if self.done != "nothing":
            return [f"{self.url}: {self.done}, {total}; tag {self.tag} is commit {self.commit}"]
        lines = [f"{size:>15,}  {name}" for name, size in self.files.items()]
        lines += [f"would delete  {name}, which this version does not have" for name in self.deletes]
        new = f"new {'private' if self.private else 'public'} " if self.creates else ""
        return [*lines, f"would upload {total} to the {new}dataset repository {self.repo}, and tag them {self.tag}"]


def upload_release(
    folder: Path,
    address: str,
    *,
    private: bool = False,
    dry_run: bool = False,
    show: bool = False,
    advance: NamedProgress = lambda what, done, total: None,
) -> Upload:
    """Upload a release, compare the repository's content with its manifest, and tag that commit.

    Files that are in the repository already are not sent again, so that the same call resumes an interrupted upload.

    Args:
        folder: the release; it is verified first.
        address: hf://datasets/ORG/REPO; a missing repository is created.
        private: make a new repository private, and accept an existing one only if it is private.
        dry_run: change nothing.
        show: show the client's progress bars.
        advance: progress of verifying.

    Raises:
        ReleaseError: if the release is not valid.
        OptionError: if the address has another form.
        UploadError: if the Hub refuses or cannot be reached, the tag has other content, the repository has files that
            belong to no release, or its content differs from the manifest after the upload.
    """
    from huggingface_hub import HfApi

    repo = _repo_of(address)
    check_valid(folder, advance)
    manifest = read_manifest(folder) | {MANIFEST: file_hash(folder / MANIFEST)}
    files = {name: _File((folder / name).stat().st_size, digest) for name, digest in manifest.items()}
    tag = f"v{read_info(folder).data_version}"
    api = HfApi()
    uploader = _Uploader(api, folder, repo, tag, files)
    with _wrap_hub_errors(uploader), _progress_bars(show):
        sizes = {name: files[name].size for name in sorted(files)}
        plan = Upload(repo, tag, f"{api.endpoint}/datasets/{repo}", sizes)
        return uploader.run(plan, private, dry_run)


@dataclass
class _Uploader:
    """One upload; `files` has the size and hash of every file of the release, `sending` is set by the first request
    that changes the repository."""

    api: HfApi
    folder: Path
    repo: str
    tag: str
    files: Mapping[str, _File]
    sending: bool = False

    def run(self, plan: Upload, private: bool, dry_run: bool) -> Upload:
        tags = self._tags()
        if tags is not None and self.tag in tags:
            differences = self._differences(self._tree(tags[self.tag]))
            if differences:
                raise UploadError(
                    f"{self.repo}: tag {self.tag} has other content: {_some(differences)}; tags do not move: give the "
                    "data another data version"
                )
            return replace(plan, done="already there", commit=tags[self.tag])
        if private and tags is not None and not self.api.repo_info(self.repo, repo_type=_KIND).private:
            raise UploadError(f"{self.repo}: is public; make it private in its settings, or give another repository")
        foreign = [] if tags is None else self._foreign()
        plan = replace(plan, creates=tags is None, private=private, deletes=foreign)
        if dry_run:
            return plan
        self.sending = True
        if tags is None:
            self.api.create_repo(self.repo, repo_type=_KIND, private=private, exist_ok=True)
        self.api.upload_folder(
            repo_id=self.repo,
            repo_type=_KIND,
            folder_path=self.folder,
            commit_message=f"Data version {self.tag.removeprefix('v')}",
            delete_patterns=foreign or None,
        )
        commit = self.api.repo_info(self.repo, repo_type=_KIND).sha or "main"
        differences = self._differences(self._tree(commit))
        if differences:
            raise UploadError(
                f"{self.repo}: after the upload, commit {commit} is not the release: {_some(differences)}; it was "
                "not tagged; run the same command again"
            )
        self.api.create_tag(self.repo, tag=self.tag, revision=commit, repo_type=_KIND)
        return replace(plan, done="uploaded", commit=commit)

    def _tags(self) -> dict[str, str] | None:
        """Return tag -> commit; None if there is no such repository."""
        from huggingface_hub.errors import RepositoryNotFoundError

        try:
            refs = self.api.list_repo_refs(self.repo, repo_type=_KIND)
        except RepositoryNotFoundError:
            return None
        return {reference.name: reference.target_commit for reference in refs.tags}

    def _tree(self, revision: str) -> dict[str, RepoFile]:
        """Return path -> the Hub's size and hashes of the file."""
        from huggingface_hub.hf_api import RepoFile

        listed = self.api.list_repo_tree(self.repo, recursive=True, revision=revision, repo_type=_KIND)
        return {entry.path: entry for entry in listed if isinstance(entry, RepoFile) and entry.path != _HUB_FILE}

    def _foreign(self) -> list[str]:
        """Return the files of the repository that belong to another version of the release.

        Raises:
            UploadError: if there are files that the repository's manifest does not list.
        """
        tree = self._tree("main")
        foreign = sorted(tree.keys() - self.files.keys())
        listed: Mapping[str, str] = {}
        if foreign and MANIFEST in tree:
            path = self.api.hf_hub_download(self.repo, MANIFEST, repo_type=_KIND)
            listed = read_manifest(Path(path).parent)
        unknown = [name for name in foreign if name not in listed]
        if unknown:
            raise UploadError(
                f"{self.repo}: has {len(unknown)} files that belong to no release, such as {unknown[0]}: expected an "
                "empty repository or one with a release; remove them, or give another repository"
            )
        return foreign

    def _differences(self, tree: Mapping[str, RepoFile]) -> list[str]:
        """Return the differences between a tree of the repository and the release."""
        found = [f"{name}: not in the release" for name in sorted(tree.keys() - self.files.keys())]
        for name, file in self.files.items():
            remote = tree.get(name)
            if remote is None:
                found.append(f"{name}: missing")
            elif remote.size != file.size:
                found.append(f"{name}: expected {file.size} bytes, found {remote.size}")
            elif remote.lfs is not None and remote.lfs.sha256 != file.sha256:
                found.append(f"{name}: expected sha256 {file.sha256}, found {remote.lfs.sha256}")
            elif remote.lfs is None and remote.blob_id != (blob := git_hash((self.folder / name).read_bytes())):
                found.append(f"{name}: expected git's blob {blob}, found {remote.blob_id}")
        return found


def _repo_of(address: str) -> str:
    found = re.fullmatch(r"hf://datasets/([\w.-]+/[\w.-]+)/?", address)
    if found is None:
        raise OptionError(f"{address!r}: expected hf://datasets/ORG/REPO; the revision is the data version's tag")
    return found[1]


def _some(differences: list[str]) -> str:
    more = f"; and {len(differences) - 3} more" if len(differences) > 3 else ""
    return "; ".join(differences[:3]) + more


@contextmanager
def _progress_bars(show: bool) -> Iterator[None]:
    """Show progress bars of huggingface_hub only if `show`."""
    from huggingface_hub.utils import are_progress_bars_disabled, disable_progress_bars, enable_progress_bars

    if show or are_progress_bars_disabled():
        yield
        return
    disable_progress_bars()
    try:
        yield
    finally:
        enable_progress_bars()


@contextmanager
def _wrap_hub_errors(uploader: _Uploader) -> Iterator[None]:
    """Raise errors of the Hub's client as `UploadError`, which names the repository, the cause and a remedy."""
    from huggingface_hub.errors import HTTPError, LocalTokenNotFoundError  # pyright: ignore[reportPrivateImportUsage]

    try:
        yield
    except Icrl4ahtError:
        raise
    except (HTTPError, OSError, RuntimeError, ValueError) as error:
        cause = error.__cause__ if isinstance(error, RuntimeError) and error.__cause__ else error
        status = getattr(getattr(cause, "response", None), "status_code", None)
        repo, endpoint, remedy = uploader.repo, uploader.api.endpoint, "nothing was sent: run the same command again"
        if uploader.sending:
            remedy = "files sent so far are kept: run the same command to resume"
        if status in (401, 403) or isinstance(cause, (LocalTokenNotFoundError, PermissionError)):
            remedy = f"expected a token that may write to {repo.split('/')[0]}: `hf auth login`, or set HF_TOKEN"
        elif isinstance(cause, ValueError):
            remedy = "correct it, then run the same command"
        lines = [line.strip() for line in str(cause).splitlines()]
        text = " ".join(line for line in lines if line and not line.startswith("For more information"))
        raise UploadError(f"{repo} at {endpoint}: {text or repr(cause)}; {remedy}") from error

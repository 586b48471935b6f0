"""Upload of a release to the Hugging Face Hub, followed by a comparison of the files and a tag for the commit."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from icrl4aht_data.checking.report import NamedProgress
from icrl4aht_data.errors import Icrl4ahtError, OptionError, UploadError
from icrl4aht_data.format.info import read_info
from icrl4aht_data.format.manifest import read_manifest
from icrl4aht_data.format.schema import MANIFEST
from icrl4aht_data.publishing.build import check_valid, first_problems
from icrl4aht_data.utils.text import counted_noun

if TYPE_CHECKING:
    from huggingface_hub import HfApi


@dataclass(frozen=True)
class Upload:
    """Result of `upload_release`; in a dry run, the plan of the upload.

    Args:
        repo: ORG/REPO.
        tag: the data version's tag.
        url: address of the repository's page.
        files: path -> size in bytes, for all files of the release.
        done: "already there" if the tag has this content; otherwise "uploaded", or "nothing" in a dry run.
        creates: whether a new repository is created.
        private: whether a private repository was requested.
        deletes: files of another version, which are removed from the repository.
        commit: the tagged commit; None if the tag does not exist yet.
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

    def report_lines(self) -> list[str]:
        """Return lines of text for printing: all files if the upload is only planned, otherwise a summary."""
        total = f"{len(self.files)} files, {sum(self.files.values()):,} bytes"
        if self.done != "nothing":
            return [f"{self.url}: {self.done}, {total}; tag {self.tag} is commit {self.commit}"]
        lines = [f"{size:>15,}  {name}" for name, size in self.files.items()]
        lines += [f"would delete  {name}, which this version does not have" for name in self.deletes]
        new = f"new {'private' if self.private else 'public'} " if self.creates else ""
        return [*lines, f"would upload {total} to the {new}dataset repository {self.repo}, and tag them {self.tag}"]


def upload_release(
    folder: str | Path,
    address: str,
    *,
    private: bool = False,
    dry_run: bool = False,
    advance: NamedProgress = lambda what, done, total: None,
) -> Upload:
    """Upload a release, compare file names and manifest of the repository with the release, and tag the commit.

    Files that are already in the repository are not sent again, so repeating the call resumes an interrupted upload.

    Args:
        folder: the release; it is verified first.
        address: hf://datasets/ORG/REPO; a missing repository is created.
        private: make a new repository private, and accept an existing repository only if it is private.
        dry_run: only return the plan, and change nothing.
        advance: called while verifying, with the name of a stage, the number of items done, and their total.

    Raises:
        ReleaseError: if the release is not valid.
        OptionError: if the address is not of the form hf://datasets/ORG/REPO.
        UploadError: if the Hub refuses the upload or cannot be reached, if the tag exists with other content, if the
            repository has files that belong to no release, or if it differs from the release after the upload.
    """
    from huggingface_hub import HfApi

    found, folder = re.fullmatch(r"hf://datasets/([\w.-]+/[\w.-]+)/?", str(address)), Path(folder)
    if found is None:
        raise OptionError(
            f"{address!r}: expected hf://datasets/ORG/REPO without a tag; the upload is tagged with the release's data "
            f"version"
        )
    check_valid(folder, advance)
    api, repo, version = HfApi(), found[1], read_info(folder).data_version
    sizes = {name: (folder / name).stat().st_size for name in sorted([*read_manifest(folder), MANIFEST])}
    plan = Upload(repo, f"v{version}", f"{api.endpoint}/datasets/{repo}", sizes)
    with _wrap_hub_errors(plan, api, "nothing was sent: run the same command again"):
        plan = _complete_plan(api, plan, folder, private)
    if dry_run or plan.done == "already there":
        return plan
    with _wrap_hub_errors(plan, api, "files sent so far are kept: run the same command to resume"):
        return _upload_and_tag(api, plan, folder)


def _complete_plan(api: HfApi, plan: Upload, folder: Path, private: bool) -> Upload:
    """Add the state of the repository to the plan of an upload; the repository is not changed."""
    from huggingface_hub.errors import RepositoryNotFoundError

    try:
        refs = api.list_repo_refs(plan.repo, repo_type="dataset")
    except RepositoryNotFoundError:
        return replace(plan, creates=True, private=private)
    commit = next((reference.target_commit for reference in refs.tags if reference.name == plan.tag), None)
    if commit is not None:
        if differences := _differences(api, plan, commit, folder):
            raise UploadError(
                f"{plan.repo}: tag {plan.tag} exists with other content: {first_problems(differences)}; an existing "
                "tag is never moved: give the release another data version"
            )
        return replace(plan, done="already there", commit=commit)
    if private and not api.repo_info(plan.repo, repo_type="dataset").private:
        raise UploadError(f"{plan.repo} is a public repository; make it private in its settings, or give another one")
    present = _repository_files(api, plan.repo, "main")
    foreign = sorted(present - plan.files.keys())
    has_release = foreign and MANIFEST in present
    listed = read_manifest(_get_manifest(api, plan.repo, "main").parent) if has_release else {}
    if unknown := [name for name in foreign if name not in listed]:
        raise UploadError(
            f"{plan.repo}: contains {counted_noun(len(unknown), 'file')} outside any release, such as {unknown[0]}: "
            "expected an empty repository or a release; remove such files, or give another repository"
        )
    return replace(plan, private=private, deletes=foreign)


def _upload_and_tag(api: HfApi, plan: Upload, folder: Path) -> Upload:
    """Upload the files of a plan, compare the repository with the release, and tag the commit.

    `HfApi.upload_folder` checks the files that it sends, but not whether other users commit during the upload. The
    comparison does, because a tag never moves.
    """
    repo = plan.repo
    if plan.creates:
        api.create_repo(repo, repo_type="dataset", private=plan.private, exist_ok=True)
    message = f"Data version {plan.tag.removeprefix('v')}"
    options = {"folder_path": folder, "commit_message": message, "delete_patterns": plan.deletes or None}
    api.upload_folder(repo_id=repo, repo_type="dataset", **options)
    commit = api.repo_info(repo, repo_type="dataset").sha or "main"
    if differences := _differences(api, plan, commit, folder):
        raise UploadError(
            f"{repo}: after the upload, commit {commit} differs from the release: {first_problems(differences)}; "
            "the commit was not tagged; run the same command again"
        )
    api.create_tag(repo, tag=plan.tag, revision=commit, repo_type="dataset")
    return replace(plan, done="uploaded", commit=commit)


def _differences(api: HfApi, plan: Upload, revision: str, folder: Path) -> list[str]:
    """Return the differences in file names and manifest between a revision of the repository and the release."""
    present = _repository_files(api, plan.repo, revision)
    differences = [f"{name}: not in the release" for name in sorted(present - plan.files.keys())]
    differences += [f"{name}: missing" for name in plan.files if name not in present]
    if MANIFEST in present and _get_manifest(api, plan.repo, revision).read_bytes() != (folder / MANIFEST).read_bytes():
        differences.append(f"{MANIFEST}: has other hashes")
    return differences


def _repository_files(api: HfApi, repo: str, revision: str) -> set[str]:
    """Return the paths of the repository's files, without `.gitattributes`, which the Hub adds."""
    return {*api.list_repo_files(repo, revision=revision, repo_type="dataset")} - {".gitattributes"}


def _get_manifest(api: HfApi, repo: str, revision: str) -> Path:
    """Return the path of the repository's manifest, fetched into the Hub's cache."""
    return Path(api.hf_hub_download(repo, MANIFEST, revision=revision, repo_type="dataset"))


@contextmanager
def _wrap_hub_errors(plan: Upload, api: HfApi, remedy: str) -> Iterator[None]:
    """Raise errors of the Hub's client as `UploadError` with the repository, the cause and a remedy."""
    from huggingface_hub.errors import HTTPError, LocalTokenNotFoundError  # pyright: ignore[reportPrivateImportUsage]

    try:
        yield
    except Icrl4ahtError:
        raise
    except (HTTPError, OSError, RuntimeError, ValueError) as error:
        cause = error.__cause__ if isinstance(error, RuntimeError) and error.__cause__ else error
        status = getattr(getattr(cause, "response", None), "status_code", None)
        if status in (401, 403) or isinstance(cause, (LocalTokenNotFoundError, PermissionError)):
            owner = plan.repo.split("/")[0]
            remedy = f"expected a token that may write to {owner}: `hf auth login`, or set HF_TOKEN"
        elif isinstance(cause, ValueError):
            remedy = "correct it, then run the same command"
        text = " ".join(str(cause).split()) or repr(cause)
        raise UploadError(f"{plan.repo} at {api.endpoint}: {text}; {remedy}") from error

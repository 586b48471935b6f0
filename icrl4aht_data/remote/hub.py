"""Dataset repositories of the Hugging Face Hub: byte ranges at one commit, and complete files by its own client."""

from __future__ import annotations

import glob
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from icrl4aht_data.errors import OfflineError, RemoteError
from icrl4aht_data.remote.store import RetryPolicy, Store, WrongLengthError, http_status, offline, wrap_remote_errors


class HubStore(Store):
    """Files of a dataset repository of the Hub at one commit.

    For a large file the Hub answers with a redirect to its storage. The location is requested once and then read by
    ranges, so that a range costs one request.

    Args:
        repo: <org>/<repo>.
        commit: all 40 hexadecimal digits.
        retry: policy for transient errors.
    """

    def __init__(self, repo: str, commit: str, retry: RetryPolicy | None = None) -> None:
        super().__init__(f"hf://datasets/{repo}@{commit}", retry)
        self.repo, self._commit = repo, commit
        self._filesystem_url = "https://"
        self._metadata: dict[str, Any] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.repo, self._commit, self.retry)

    def _file_metadata(self, name: str) -> Any:
        """`HfFileMetadata` of a file, of which `location` and `size` are used here."""
        from huggingface_hub import get_hf_file_metadata, hf_hub_url

        if name not in self._metadata:
            url = hf_hub_url(self.repo, name, repo_type="dataset", revision=self._commit)
            self._metadata[name] = get_hf_file_metadata(url)
        return self._metadata[name]

    def _size(self, name: str) -> int:
        size = self._file_metadata(name).size
        if size is None:
            raise WrongLengthError("the Hub does not say how long the file is")
        return int(size)

    def _read(self, name: str, start: int, stop: int) -> bytes:
        from huggingface_hub import constants
        from huggingface_hub.utils import build_hf_headers

        location = self._file_metadata(name).location
        on_hub = urlsplit(location).netloc == urlsplit(constants.ENDPOINT).netloc
        headers = build_hf_headers() if on_hub else {}  # the token must not leave the Hub
        try:
            data = self._files.cat_file(location, start=start, end=stop, headers=headers)
        except Exception as error:
            if http_status(error) in (401, 403, 404, 410) and not on_hub:  # a signed location expires
                self._metadata.pop(name, None)
                raise ConnectionError(f"{name}: its location at the Hub's storage has expired") from None
            raise
        return self._counted(name, start, stop, data)


def fetch_snapshot(
    url: str,
    repo: str,
    revision: str | None,
    names: Sequence[str],
    *,
    limit: int,
    count: Callable[[int], None] = lambda size: None,
    local_dir: Path | None = None,
) -> Path:
    """Download complete files of a dataset repository with `huggingface_hub.snapshot_download`; return their folder.

    The client resumes and retries a download by itself; nothing is retried here. Without network access, or if the Hub
    cannot be reached, the files are looked up in the client's cache.

    Args:
        url: address that errors name.
        repo: <org>/<repo>.
        revision: branch, tag or commit; None is the default branch.
        names: paths in the repository.
        limit: bytes that may arrive in total; more are an error.
        count: called with the number of bytes that have arrived since the last call.
        local_dir: folder for the files; by default the snapshot in the Hub's cache.

    Raises:
        OfflineError: if network access is switched off and a file is not in the cache.
        RemoteError: if the Hub cannot be reached within $HF_HUB_ETAG_TIMEOUT (10 s), refuses, or has no such file.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import LocalEntryNotFoundError, RepositoryNotFoundError
    from huggingface_hub.utils import tqdm

    arrived = 0

    class CountingBar(tqdm):
        """Invisible progress bar; the client has one for the bytes of all files, which it names."""

        def __init__(self, *args: Any, name: str | None = None, **options: Any) -> None:
            self._counts = name == "huggingface_hub.snapshot_download"
            super().__init__(*args, **options | {"disable": True})

        def update(self, n: float | None = 1) -> bool | None:
            nonlocal arrived
            if self._counts:
                arrived += int(n or 0)
                if arrived > limit:
                    raise RemoteError(f"{url}: {', '.join(names[:3])}: expected at most {limit:,} bytes, and more came")
                count(int(n or 0))
            return super().update(n)

    unreachable = None if offline() else _connection_error(repo, revision, names[0])
    options: dict[str, Any] = {"repo_type": "dataset", "revision": revision, "local_dir": local_dir}
    options |= {"local_files_only": offline() or unreachable is not None, "tqdm_class": CountingBar}
    patterns, folder = [glob.escape(name) for name in names], Path()
    with wrap_remote_errors(f"{url}/{', '.join(names[:3])}"):
        try:
            folder = Path(snapshot_download(repo, allow_patterns=patterns, **options))
            absent = [name for name in names if not (folder / name).exists()]
        except RepositoryNotFoundError as error:  # status 401 for a client without a token
            raise RemoteError(f"{url}: the Hub has no such repository, or it is private", missing=True) from error
        except LocalEntryNotFoundError as error:
            if not options["local_files_only"]:
                raise
            absent = list(names)
            unreachable = unreachable or error
        if absent and offline():
            listed = ", ".join(absent)
            raise OfflineError(f"{url}: offline, and not in the Hub's cache: {listed}; go online to fetch it")
        if absent and unreachable is not None:
            raise unreachable
        if absent:
            raise FileNotFoundError(absent[0])
    return folder


def listed_sizes(repo: str, commit: str) -> dict[str, int]:
    """Path -> bytes of all files at a commit, as listed when the client downloaded from it; empty without a listing."""
    from huggingface_hub import get_cached_repo_tree
    from huggingface_hub.errors import CachedRepoTreeNotFoundError

    try:
        return {file.path: file.size for file in get_cached_repo_tree(repo, repo_type="dataset", revision=commit)}
    except CachedRepoTreeNotFoundError:
        return {}


def _connection_error(repo: str, revision: str | None, name: str) -> Exception | None:
    """The error of a first request if the Hub does not answer it in time; None if it does, whatever the answer.

    The client waits without a time-out for some answers and for minutes for others, hence this request before them.
    """
    from huggingface_hub import constants, get_hf_file_metadata, hf_hub_url
    from huggingface_hub.errors import FileMetadataError, HfHubHTTPError

    try:
        url = hf_hub_url(repo, name, repo_type="dataset", revision=revision)
        get_hf_file_metadata(url, timeout=constants.HF_HUB_ETAG_TIMEOUT)
    except (HfHubHTTPError, FileMetadataError):
        return None
    except Exception as error:  # classes of the HTTP library that the client is built on
        return error
    return None

"""Dataset repositories of the Hugging Face Hub: byte ranges by URL, and complete files by the Hub's own client."""

from __future__ import annotations

import glob
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from icrl4aht_data.errors import OfflineError, RemoteError
from icrl4aht_data.remote.addresses import check_redirect
from icrl4aht_data.remote.store import RetryPolicy, Store, WrongLengthError, http_status, offline, wrap_remote_errors
from icrl4aht_data.utils.files import TEXT_BYTES


class HubStore(Store):
    """Files of a dataset repository of the Hub at one revision.

    For a large file the Hub answers with a redirect to its storage. The location is requested once and then read by
    ranges, so that a range costs one request.

    Args:
        repo: <org>/<repo>.
        revision: branch, tag or commit; None is the default branch.
        retry: policy for byte ranges.
    """

    def __init__(self, repo: str, revision: str | None, retry: RetryPolicy | None = None) -> None:
        super().__init__(f"hf://datasets/{repo}{f'@{revision}' if revision else ''}", retry)
        self.repo, self.revision = repo, revision
        self._address = "https://"  # of the file system for byte ranges
        self._metadata: dict[str, Any] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.repo, self.revision, self.retry)

    def fetch_files(
        self, names: Sequence[str], limit: int, advance: Callable[[int], None], local_dir: Path | None = None
    ) -> Path:
        """Download complete files with `huggingface_hub.snapshot_download`; return the folder that has them.

        The client retries and resumes by itself; nothing is retried here. Without network access, or if the Hub cannot
        be reached, the files are looked up in the client's cache.

        Args:
            names: paths in the repository.
            limit: bytes that may arrive in total; more are an error.
            advance: called with the number of bytes since the last call.
            local_dir: folder for the files; by default the snapshot in the Hub's cache.

        Raises:
            OfflineError: if network access is switched off and a file is not in the cache.
            RemoteError: if the Hub does not answer within $HF_HUB_ETAG_TIMEOUT (10 s), refuses, or has no such file.
        """
        from huggingface_hub import snapshot_download
        from huggingface_hub.errors import LocalEntryNotFoundError, RepositoryNotFoundError
        from huggingface_hub.utils import tqdm

        address, arrived = f"{self.url}/{', '.join(names[:3])}", 0

        class CountingBar(tqdm):
            """Invisible progress bar; the client makes several, the named one counts the bytes of all files."""

            def __init__(self, *args: Any, name: str | None = None, **options: Any) -> None:
                self._counts = name == "huggingface_hub.snapshot_download"
                super().__init__(*args, **options | {"disable": True})

            def update(self, n: float | None = 1) -> bool | None:
                nonlocal arrived
                if self._counts:
                    arrived += int(n or 0)
                    if arrived > limit:
                        raise RemoteError(f"{address}: expected at most {limit:,} bytes, and more came")
                    advance(int(n or 0))
                return super().update(n)

        unreachable = None if offline() else self._connection_error(names[0])
        options: dict[str, Any] = {"repo_type": "dataset", "revision": self.revision, "local_dir": local_dir}
        options |= {"allow_patterns": [glob.escape(name) for name in names], "tqdm_class": CountingBar}
        options["local_files_only"] = cache_only = offline() or unreachable is not None
        folder, absent = Path(), list(names)
        with wrap_remote_errors(address), _limited_answers(self.url):
            try:
                folder = Path(snapshot_download(self.repo, **options))
                absent = [name for name in names if not (folder / name).exists()]
            except RepositoryNotFoundError as error:  # status 401 for a client without a token
                raise RemoteError(f"{self.url}: no such repository, or a private one", missing=True) from error
            except LocalEntryNotFoundError:
                if not cache_only:
                    raise
            if absent and offline():
                listed = ", ".join(absent)
                raise OfflineError(f"{self.url}: offline, and not in the Hub's cache: {listed}; go online to fetch it")
            if absent:
                raise unreachable or FileNotFoundError(absent[0])
        self.count(len(names), arrived)
        advance(sum((folder / name).stat().st_size for name in names) - arrived)  # what the cache had by another name
        return folder

    def _connection_error(self, name: str) -> Exception | None:
        """The error of a first request that the Hub does not answer in time; None if it answers, with any status.

        The client waits without a time-out for some answers and for minutes for others, hence this request before them.
        """
        from huggingface_hub import constants, get_hf_file_metadata, hf_hub_url
        from huggingface_hub.errors import FileMetadataError, HfHubHTTPError

        try:
            url = hf_hub_url(self.repo, name, repo_type="dataset", revision=self.revision)
            with suppress(HfHubHTTPError, FileMetadataError):
                get_hf_file_metadata(url, timeout=constants.HF_HUB_ETAG_TIMEOUT)
        except Exception as error:  # a class of the HTTP library that the client is built on
            return error
        return None

    def size(self, name: str) -> int:
        return self._listed_sizes[name] if name in self._listed_sizes else super().size(name)

    @cached_property
    def _listed_sizes(self) -> dict[str, int]:
        """Path -> bytes in the listing that `snapshot_download` has cached; empty without one."""
        from huggingface_hub import get_cached_repo_tree
        from huggingface_hub.errors import CachedRepoTreeNotFoundError

        with suppress(CachedRepoTreeNotFoundError):
            listed = get_cached_repo_tree(self.repo, repo_type="dataset", revision=self.revision)
            return {file.path: file.size for file in listed}
        return {}

    def _file_metadata(self, name: str) -> Any:
        """`HfFileMetadata` of a file, of which `location` and `size` are used here."""
        from huggingface_hub import get_hf_file_metadata, hf_hub_url

        if name not in self._metadata:
            url = hf_hub_url(self.repo, name, repo_type="dataset", revision=self.revision)
            found = get_hf_file_metadata(url)
            check_redirect(url, found.location, trusted=True)  # the Hub keeps large files on other hosts
            self._metadata[name] = found
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


@contextmanager
def _limited_answers(url: str) -> Iterator[None]:
    """Bound the bytes of all answers of the Hub's API, and of errors, together: its client reads them without limit.

    Raises:
        RemoteError: if more than `TEXT_BYTES` come.
    """
    from huggingface_hub import get_session

    left = TEXT_BYTES

    def limit(response: Any) -> None:
        path, read = response.url.path, response.iter_bytes
        if response.status_code < 400 and ("/api/" not in path or "/resolve/" in path):
            return

        def iter_bytes(chunk_size: int | None = None) -> Iterator[bytes]:
            nonlocal left
            for part in read(chunk_size):
                left -= len(part)
                if left < 0:
                    raise RemoteError(f"{url}: expected at most {TEXT_BYTES:,} bytes from the Hub's API, and more came")
                yield part

        response.iter_bytes = iter_bytes  # decoded, so that a small compressed answer cannot become a huge one

    hooks = get_session().event_hooks["response"]
    hooks.append(limit)
    try:
        yield
    finally:
        hooks.remove(limit)

"""Test remote releases over HTTP, S3 and the Hub: opening, reading, downloading and faults of servers."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from huggingface_hub import file_download
from huggingface_hub.utils import _http

from icrl4aht_data import clients, load_icrl4aht, verify_release
from icrl4aht_data.clients import check_credentials, without_credentials
from icrl4aht_data.errors import (
    Icrl4ahtError,
    IndexFormatError,
    OfflineError,
    OptionError,
    RemoteError,
    RootNotFoundError,
    ShardCorruptError,
    UnknownNameError,
)
from icrl4aht_data.fetch import fetch_planned, plan_download
from icrl4aht_data.format.chunks import chunk_table_name
from icrl4aht_data.format.manifest import write_manifest
from icrl4aht_data.format.schema import HISTORIES, INFO, MANIFEST
from icrl4aht_data.utils import files as disk
from tests.helpers.batches import assert_equal_batches
from tests.helpers.commands import run_cli
from tests.helpers.damages import file_contents, flip_bit
from tests.helpers.random_releases import SHARD
from tests.servers.faults import (
    ErrorStatus,
    Fault,
    FlippedByte,
    LongBody,
    Redirect,
    ShortBody,
    SlowAnswer,
    TruncatedBody,
)
from tests.servers.http import Answer, Server, http_server
from tests.servers.hub import Hub, hub_server
from tests.servers.process import hub_environment, hub_settings
from tests.servers.s3 import s3_server

TABLE = chunk_table_name(SHARD)
HUB = "hf://datasets/org/name"
ALWAYS = 10**9


@pytest.fixture(autouse=True)
def data_folder(tmp_path, monkeypatch) -> Path:
    """Set an empty data folder, shorten the waits before retries, and return the folder."""
    monkeypatch.setenv("ICRL4AHT_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.delenv("ICRL4AHT_REMOTE", raising=False)
    monkeypatch.setattr(clients, "_WAITS", (0.01, 0.01, 0.01))
    hurried = SimpleNamespace(**vars(time) | {"sleep": lambda seconds: time.sleep(seconds / 500)})
    monkeypatch.setattr(_http, "time", hurried)
    monkeypatch.setattr(file_download, "time", hurried)
    return tmp_path / "data"


@contextmanager
def serve_release(kind: str, folder: Path) -> Iterator[tuple[str, Server | Hub | None]]:
    """Serve a release; yield its address, and the server if the server can inject faults."""
    if kind == "http":
        with http_server(folder) as server:
            yield server.url, server
    elif kind == "s3":
        with s3_server(folder) as bucket:
            yield bucket, None
    else:
        with tempfile.TemporaryDirectory() as root, hub_server(Path(root)) as hub:
            hub.add_repo("org/name", folder)
            yield HUB, hub


KINDS = pytest.mark.parametrize("kind", ["http", "hub", pytest.param("s3", marks=pytest.mark.slow)])


def load_batch(root, layout="demo_wide", **options):
    return load_icrl4aht(root, layout=layout, **options).ad(batch_size=8, length=30)[0]


def shard_names(folder: Path) -> set[str]:
    return {path.name for path in (folder / "data").rglob("*.h5")}


# Tests of reading remote releases


def test_older_remote_releases_that_contain_source_card_md_can_be_opened(lite, tmp_path):
    shutil.copytree(lite[0], tmp_path / "served")
    (tmp_path / "served" / "meta" / "source_card.md").write_text("# card\n")
    write_manifest(tmp_path / "served")
    with http_server(tmp_path / "served") as server:
        assert len(load_icrl4aht(server.url)) == len(load_icrl4aht(tmp_path / "served"))


@KINDS
def test_a_remote_release_equals_its_local_copy(kind, lite, monkeypatch):
    local = load_icrl4aht(lite[0])
    with serve_release(kind, lite[0]) as (url, _):
        remote = load_icrl4aht(url)
        assert [h.entry for h in remote] == [h.entry for h in local]
        assert remote.info == local.info and remote.recover_teammate(3) == local.recover_teammate(3)
        assert not shard_names(remote.root), "opening fetches the index only"
        one = remote.filter(layout="demo_wide")
        assert np.array_equal(one[0].expert_actions, local.filter(layout="demo_wide")[0].expert_actions)
        assert len(shard_names(remote.root)) == 1, "a shard is fetched when one of its histories is read"
        assert_equal_batches(load_batch(pickle.loads(pickle.dumps(one)).origin.folder), load_batch(lite[0]))
        for cache in ("auto", "ram", "mmap", "stream"):
            assert_equal_batches(load_batch(url, "coord_simple", cache=cache), load_batch(lite[0], "coord_simple"))
        monkeypatch.setenv("ICRL4AHT_OFFLINE", "1")
        assert_equal_batches(load_batch(url), load_batch(lite[0]))
    assert not [path for path in remote.root.parent.rglob("*") if "partial" in path.name or path.suffix == ".lock"]


@KINDS
@pytest.mark.parametrize("variable", ["HF_HUB_OFFLINE", "ICRL4AHT_OFFLINE"])
def test_offline_mode_reads_only_downloaded_files(kind, lite, variable, monkeypatch):
    with serve_release(kind, lite[0]) as (url, _):
        monkeypatch.setenv(variable, "1")
        message = rf"offline, and this release is not downloaded.*; unset {variable} to download"
        with pytest.raises(OfflineError, match=message):
            load_icrl4aht(url)
        monkeypatch.delenv(variable)
        fetch_planned(plan_download(url, layout="demo_wide"))
        monkeypatch.setenv(variable, "1")
        assert_equal_batches(load_batch(url), load_batch(lite[0]))
        message = rf"offline, but these files are missing.*: .*data/teammate/coord_simple/train-0.*; unset {variable}"
        with pytest.raises(OfflineError, match=message):
            load_batch(url, "coord_simple", cache="ram")


def test_new_version_at_an_address_is_opened_as_another_release(lite, full, tmp_path):
    shutil.copytree(lite[0], tmp_path / "served")
    with http_server(tmp_path / "served") as server:
        first = load_icrl4aht(server.url)
        shutil.rmtree(tmp_path / "served")
        shutil.copytree(full[0], tmp_path / "served")
        second = load_icrl4aht(server.url)
        assert (first.info.kind, second.info.kind) == ("lite", "full") and first.root != second.root
        with pytest.raises(RemoteError, match=r"(expected sha256|the server sent more|no such file)"):
            _ = first[0].actions


def test_hub_revision_is_pinned_and_shown(lite, full, tmp_path):
    with hub_server(tmp_path / "hub") as hub:
        first = hub.add_repo("org/name", lite[0], tag="v0.0.1")
        hub.add_repo("org/name", full[0])
        tagged, newest = load_icrl4aht(f"{HUB}@v0.0.1"), load_icrl4aht(HUB)
        assert (tagged.info.kind, newest.info.kind) == ("lite", "full")
        assert str(tagged.origin) == f"{HUB}@{first}"
        shown = json.loads(run_cli("show", f"{HUB}@v0.0.1", "--json"))
        assert (shown["revision"], shown["data_version"]) == (first, tagged.info.data_version)


# Tests of downloading


@KINDS
def test_partial_download_can_be_completed_later(kind, lite, tmp_path):
    target = tmp_path / "mine"
    with serve_release(kind, lite[0]) as (url, _):
        plan = plan_download(url, to=target, layout="demo_wide")
        assert sum(name.endswith(".h5") for name in plan.files) == 1
        advanced: list[int] = []
        fetch_planned(plan, advanced.append)
        assert sum(advanced) == plan.size == sum(plan.files[name] for name in plan.absent) > 0
        assert verify_release(target, layout="demo_wide").ok
        assert verify_release(target).files_at_fault >= {SHARD, TABLE}
        fetch_planned(plan_download(url, to=target))
        assert plan_download(url, to=target).size == 0
        report = verify_release(url, level="deep", layout="demo_wide")
        assert report.ok, report.findings
        assert verify_release(url, level="quick").ok
    assert verify_release(target, level="deep").notes == []
    assert file_contents(target) == file_contents(lite[0])
    (target / SHARD).unlink()
    assert verify_release(target).files_at_fault == {SHARD}
    assert {path.name for path in tmp_path.iterdir()} <= {"mine", "data", "hub"}, "no locks"


def test_download_command_fetches_missing_and_changed_files(lite, tmp_path, monkeypatch):
    target = tmp_path / "mine"
    with http_server(lite[0]) as server:
        plan = json.loads(run_cli("download", server.url, "--layout", "demo_wide", "--dry-run", "--json"))
        assert plan["bytes"] == sum(plan["files"][name] for name in plan["absent"]) > 0
        monkeypatch.setenv("ICRL4AHT_REMOTE", server.url)
        printed = run_cli("download", "--to", target)
        assert "bytes downloaded" in printed
        files = len(file_contents(target)) - 1
        for name in (SHARD, "README.md"):
            flip_bit(target / name)
        again = run_cli("download", "--to", target)
        assert f"{SHARD}: had changed, was fetched again" in again
        assert "2 files," in again and f"{files - 2} files present already, with the right hashes" in again
        run_cli("convert", server.url, "--out", tmp_path / "full", "--to", "full")
        assert verify_release(tmp_path / "full", level="deep").ok
    assert file_contents(target) == file_contents(lite[0])


def test_download_refuses_folders_with_other_content(lite, full, tmp_path):
    target = tmp_path / "home"
    target.mkdir()
    (target / ".bashrc").write_text("mine")
    with http_server(lite[0]) as server:
        with pytest.raises(OptionError, match="not empty, and not this version of"):
            plan_download(server.url, to=target)
        assert [path.name for path in target.iterdir()] == [".bashrc"]
        shutil.rmtree(target)
        shutil.copytree(full[0], target)
        with pytest.raises(OptionError, match="not empty, and not this version of"):
            plan_download(server.url, to=target)
    assert file_contents(target) == file_contents(full[0])


KILLED = """
import sys
from pathlib import Path
from icrl4aht_data.fetch import fetch_planned, plan_download
fetch_planned(plan_download(sys.argv[1], to=Path(sys.argv[2]) if len(sys.argv) > 2 else None))
"""


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "to"), [("http", "mine"), ("hub", None)])
def test_killed_download_resumes_with_the_missing_files(kind, to, lite, tmp_path):
    arguments = [str(tmp_path / to)] if to else []
    with serve_release(kind, lite[0]) as (url, server):
        assert server is not None
        server.faults.next(SlowAnswer(bytes_per_second=2000), times=ALWAYS, path="*.h5")
        environment = os.environ | (server.environment if isinstance(server, Hub) else {})
        running = subprocess.Popen([sys.executable, "-c", KILLED, url, *arguments], env=environment)
        while not [request for request in server.log if request.path.endswith(".h5") and request.sent > 4000]:
            assert running.poll() is None
            time.sleep(0.02)
        running.send_signal(signal.SIGKILL)
        running.wait()
        server.faults.clear()
        plan = plan_download(url, to=tmp_path / to if to else None)
        folder = plan.root.folder
        assert not shard_names(folder), "no shard under its name"
        assert len(plan.absent) < len(plan.files) - 4, "complete files are kept"
        fetch_planned(plan)
        assert file_contents(folder).items() >= file_contents(lite[0]).items()
        assert not to or file_contents(folder) == file_contents(lite[0])


# Tests of server faults


WRONG: dict[str, tuple[Fault, str]] = {
    "other bytes": (FlippedByte(100), "expected sha256"),
    "too few": (ShortBody(7), "expected sha256|Consistency"),
    "too many": (LongBody(7), "the server sent more|Consistency|RemoteProtocolError"),
    "nothing": (ShortBody(ALWAYS), "expected sha256|Consistency"),
    "another file": (Redirect(f"/{INFO}"), "expected sha256|the server sent more|no such file"),
    "a loop": (Redirect(f"/{SHARD}"), "TooManyRedirects|no such file"),
    "absent": (ErrorStatus(404), "no such file"),
    "forbidden": (ErrorStatus(403), "403"),
    "busy for ever": (ErrorStatus(503), "503"),
    "cut for ever": (TruncatedBody(1000), "Error"),
}


@pytest.mark.parametrize("fault", WRONG)
@pytest.mark.parametrize("kind", ["http", "hub"])
def test_permanent_server_errors_are_raised_with_the_file_name(kind, fault, lite, tmp_path):
    wrong, message = WRONG[fault]
    with serve_release(kind, lite[0]) as (url, server):
        assert server is not None
        server.faults.next(wrong, times=ALWAYS, path="*.h5")
        began = time.monotonic()
        for use in (
            lambda: fetch_planned(plan_download(url, to=tmp_path / "mine")),
            lambda: load_batch(url, cache="stream"),
        ):
            with pytest.raises(RemoteError, match=message) as caught:
                use()
            assert ".h5: " in str(caught.value), "the message names the file"
        assert time.monotonic() - began < 5
        assert not shard_names(tmp_path / "mine") and not shard_names(load_icrl4aht(url).root)
        assert not list((tmp_path / "mine").glob(".partial-*"))
        server.faults.clear()
        seen = len(server.log)
        fetch_planned(plan_download(url, to=tmp_path / "mine"))
        assert not [request for request in server.log[seen:] if request.path.endswith("README.md")] or kind == "hub"
        assert_equal_batches(load_batch(url), load_batch(lite[0]))
    assert file_contents(tmp_path / "mine") == file_contents(lite[0])


@pytest.mark.parametrize(
    "fault",
    [ErrorStatus(503), ErrorStatus(429, {"Retry-After": "1"}), ErrorStatus(500), TruncatedBody(1000), TruncatedBody(0)],
    ids=str,
)
@pytest.mark.parametrize("kind", ["http", "hub"])
def test_transient_errors_are_retried(kind, fault, lite, tmp_path):
    with serve_release(kind, lite[0]) as (url, server):
        assert server is not None
        for method in ("GET", "HEAD"):
            for path in ("*.h5", f"*{MANIFEST}", "*/api/*"):
                if isinstance(fault, ErrorStatus) or method == "GET":
                    server.faults.next(fault, path=path, method=method)
        plan = plan_download(url, to=tmp_path / "mine")
        fetch_planned(plan)
    assert file_contents(tmp_path / "mine") == file_contents(lite[0])


def test_a_redirect_to_another_host_is_followed(lite, tmp_path):
    with http_server(lite[0]) as other, http_server(lite[0]) as server:
        server.faults.next(Redirect(f"{other.url}/{SHARD}?X-Amz-Signature=x"), path="*.h5", method=None, times=ALWAYS)
        fetch_planned(plan_download(server.url, to=tmp_path / "mine", layout="coord_simple"))
        assert (tmp_path / "mine" / SHARD).read_bytes() == (lite[0] / SHARD).read_bytes()


def test_download_stops_at_the_first_failing_file(lite, tmp_path):
    with http_server(lite[0]) as server:
        plan = plan_download(server.url, to=tmp_path / "mine")
        server.faults.next(FlippedByte(3), times=ALWAYS)
        seen = len(server.log)
        with pytest.raises(RemoteError, match="expected sha256"):
            fetch_planned(plan)
        assert len(server.log) - seen <= min(len(plan.files), clients.THREADS + 2)
    assert set(file_contents(tmp_path / "mine")) - set(plan.absent) == set(file_contents(tmp_path / "mine"))


@pytest.mark.parametrize("what", ["http", "hub", pytest.param("s3", marks=pytest.mark.slow), "refused", "hub refused"])
def test_silent_or_unreachable_server_raises_error_within_seconds(what, tmp_path, monkeypatch):
    """The server accepts connections and never answers, or nothing listens at the address."""
    monkeypatch.setattr(clients, "_TIMEOUT", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"http://127.0.0.1:{9 if 'refused' in what else server.getsockname()[1]}"
        url = {"http": endpoint, "refused": endpoint, "s3": "s3://bucket/x"}.get(what, HUB)
        for name in ("AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3"):
            monkeypatch.setenv(name, endpoint)
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            monkeypatch.setenv(name, "test")
        began = time.monotonic()
        with hub_settings(hub_environment(endpoint, tmp_path, "token")), pytest.raises(RemoteError, match=MANIFEST):
            load_icrl4aht(url)
    assert time.monotonic() - began < 5, "by default 15 s instead of 0.5 s"


@pytest.mark.parametrize("kind", ["http", "hub"])
@pytest.mark.parametrize("path", ["*.h5", "*/api/*", f"*{INFO}"])
def test_server_that_stops_answering_times_out(kind, path, lite, tmp_path, monkeypatch):
    monkeypatch.setattr(clients, "_TIMEOUT", 0.5)
    with serve_release(kind, lite[0]) as (url, server):
        assert server is not None
        server.faults.next(SlowAnswer(60), times=ALWAYS, path=path, method=None)
        began = time.monotonic()
        if kind == "hub" or "api" not in path:
            with pytest.raises(RemoteError):
                fetch_planned(plan_download(url, to=tmp_path / "mine"))
        assert time.monotonic() - began < 5
        server.faults.clear()
        fetch_planned(plan_download(url, to=tmp_path / "mine"))
    assert file_contents(tmp_path / "mine") == file_contents(lite[0])


def test_cached_files_can_be_read_when_the_hub_is_unreachable(lite, tmp_path):
    with hub_server(tmp_path / "hub") as hub:
        hub.add_repo("org/name", lite[0])
        fetch_planned(plan_download(HUB, layout="demo_wide"))
        hub.close()
        assert_equal_batches(load_batch(HUB), load_batch(lite[0]))
        with pytest.raises(RemoteError, match=f"/{SHARD}: .*ConnectError|/{TABLE}: .*ConnectError"):
            load_batch(HUB, "coord_simple")


# Tests of changed files and of credentials


@pytest.mark.parametrize("kind", ["http", "hub"])
@pytest.mark.parametrize("name", [INFO, HISTORIES, TABLE, SHARD])
def test_changed_cached_file_is_fetched_again(kind, name, lite):
    with serve_release(kind, lite[0]) as (url, _):
        assert_equal_batches(load_batch(url, "coord_simple"), load_batch(lite[0], "coord_simple"))
        path = load_icrl4aht(url).root / name
        path.resolve().write_bytes(path.read_bytes()[:-5])
        assert_equal_batches(load_batch(url, "coord_simple"), load_batch(lite[0], "coord_simple"))
        assert path.read_bytes() == (lite[0] / name).read_bytes()


@pytest.mark.parametrize("kind", ["http", "hub"])
def test_shard_with_wrong_bytes_of_the_right_size_is_not_used(kind, lite):
    """A download that is killed before its check can leave such a shard in the Hub's cache."""
    with serve_release(kind, lite[0]) as (url, _):
        plan = plan_download(url)
        fetch_planned(plan)
        path = plan.root.folder / SHARD
        path.resolve().write_bytes(bytes(255 - byte for byte in path.read_bytes()))
        with pytest.raises(ShardCorruptError, match=f"{SHARD}: .* `icrl4aht-data download` replaces it"):
            load_batch(url, "coord_simple")
        plan = plan_download(url)
        assert plan.changed == [SHARD]
        fetch_planned(plan)
        assert path.read_bytes() == (lite[0] / SHARD).read_bytes()


@pytest.mark.parametrize("kind", ["http", "hub"])
def test_endless_metadata_stops_at_a_limit(kind, lite, monkeypatch):
    monkeypatch.setattr(disk, "TEXT_BYTES", 100_000)
    with serve_release(kind, lite[0]) as (url, server):
        assert server is not None
        server.faults.next(LongBody(3_000_000), times=ALWAYS, path=f"*{INFO}")
        with pytest.raises(RemoteError, match=f"{INFO}: expected at most 100,000 bytes, but the server sent more"):
            load_icrl4aht(url)


@pytest.mark.parametrize("kind", ["http", "hub"])
def test_damaged_remote_manifests_raise_errors(kind, lite, tmp_path):
    root = tmp_path / "release"
    shutil.copytree(lite[0], root)
    (root / MANIFEST).write_text("")
    for use in (load_icrl4aht, lambda url: plan_download(str(url))):
        with (
            serve_release(kind, root) as (url, _),
            pytest.raises(IndexFormatError, match="empty: expected a line for each file"),
        ):
            use(url)
    with http_server(lite[0]) as server:
        server.faults.next(FlippedByte(70), path=f"*{MANIFEST}")
        with pytest.raises(Icrl4ahtError):
            fetch_planned(plan_download(server.url))
        assert_equal_batches(load_batch(server.url), load_batch(lite[0]))


@pytest.mark.parametrize(
    ("url", "error", "message"),
    [
        ("{server}/nowhere", RootNotFoundError, r"no release at this address, expected MANIFEST\.sha256"),
        ("{hub}", RootNotFoundError, r"no release at this address, expected MANIFEST\.sha256"),
        ("hf://datasets/org/absent", RootNotFoundError, "no release at this address"),
        ("hf://datasets/org/empty@v9", RootNotFoundError, "no release at this address"),
        ("hf://org/name", OptionError, "expected hf://datasets/<org>/<repo>"),
        ("gopher://old/times", OptionError, "not an address that fsspec opens"),
        ("http:///x", RemoteError, "(?i)InvalidUrl"),
        ("http://127.0.0.1:9/release", RemoteError, r"MANIFEST\.sha256: .*repeat the command"),
    ],
)
def test_invalid_addresses_raise_errors(url, error, message, lite, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "README.md").write_text("hello")
    with http_server(lite[0]) as server, hub_server(tmp_path / "hub") as hub:
        hub.add_repo("org/empty", tmp_path / "empty")
        with pytest.raises(error, match=message):
            load_icrl4aht(url.format(server=server.url, hub="hf://datasets/org/empty"))
        with pytest.raises(UnknownNameError, match="unknown layout 'demo_wid'; valid: coord_simple"):
            plan_download(server.url, layout="demo_wid")


def test_the_token_is_sent_to_the_hub_only(lite):
    with serve_release("hub", lite[0]) as (url, hub):
        load_batch(url)
        assert isinstance(hub, Hub)
        sent = {(request.path.startswith("/cdn/"), request.headers["Authorization"]) for request in hub.log}
        assert sent == {(False, f"Bearer {hub.token}"), (True, None)}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("https://u:p@h.test/a?token=t", "https://h.test/a"),
        ("GET https://u:p@h.test:8/a?x=1&y=2, then", "GET https://h.test:8/a then"),
        ("hf://datasets/org/name@v1", "hf://datasets/org/name@v1"),
        ("https://u:p@ss@h.test/a@b", "https://h.test/a@b"),
    ],
)
def test_credentials_are_removed_from_texts(text, expected):
    assert without_credentials(text) == expected


def test_unencoded_credentials_are_refused_and_hidden():
    for address in ("http://user:hunter2/RET@127.0.0.1:9/x", "http://user:1/hunter2@127.0.0.1:9/x"):
        with pytest.raises(OptionError, match="percent-encode the user name and password") as caught:
            load_icrl4aht(address)
        assert "hunter2" not in str(caught.value)
    for address in ("https://h.test/a@v1", "http://127.0.0.1:80/a@v1", "https://u:p%2F@h.test:8/x", "s3://bucket/x@1"):
        check_credentials(address)


def test_credentials_in_an_address_are_used_but_never_stored_or_shown(lite, tmp_path):
    def answer_request(request, body) -> Answer:
        allowed = request.headers["Authorization"] == "Basic bWU6aHVudGVyMg==" and request.target.endswith("?key=t0ken")
        path = lite[0] / request.path.lstrip("/")
        return Answer(path) if allowed and path.is_file() else Answer(b"", 404 if allowed else 401)

    said, server = [], Server(answer_request)
    url = f"{server.url.replace('http://', 'http://me:hunter2@')}?key=t0ken"
    try:
        assert_equal_batches(load_batch(url), load_batch(lite[0]))
        said.append(repr(load_icrl4aht(url)))
        for command in (["download", url, "--to", str(tmp_path / "mine")], ["show", url], ["verify", url]):
            said.append(run_cli(*command))
        for wrong in (url.replace("?", "/nowhere?"), url.replace("hunter2", "hunter2x")):
            with pytest.raises(Icrl4ahtError) as caught:
                load_icrl4aht(wrong)
            said += [str(caught.value), str(caught.value.__cause__)]
    finally:
        server.close()
    said += [data_folder.decode(errors="replace") for data_folder in file_contents(tmp_path).values()]
    said += [str(path) for path in tmp_path.rglob("*")]
    assert not [text for text in said if "hunter2" in text or "t0ken" in text]

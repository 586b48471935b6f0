"""What a remote, its mirror, or a folder from elsewhere may not do: be believed unchecked, send readers to other hosts,
or write where it should not. Over HTTP and the Hub's protocol, served on loopback."""

from __future__ import annotations

import json
import os
import shutil
import socket
import zlib
from collections.abc import Callable
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from icrl4aht_data import load_icrl4aht, verify_release
from icrl4aht_data.commands.cli import cli
from icrl4aht_data.errors import OfflineError, OptionError, RemoteError, RootNotFoundError
from icrl4aht_data.format.chunks import chunk_table_name
from icrl4aht_data.format.schema import HISTORIES, INFO, MANIFEST
from icrl4aht_data.remote.addresses import REDIRECT_VARIABLE, check_redirect, without_credentials
from icrl4aht_data.remote.download import fetch_planned, plan_download, repair
from icrl4aht_data.remote.store import RetryPolicy, Store
from tests.helpers.batches import assert_equal
from tests.helpers.random_releases import SHARD
from tests.servers.common import Redirect, Status, http_server, hub_server
from tests.servers.http import Answer, Server

QUICK = RetryPolicy(attempts=2, first_wait=0.01)
TABLE = chunk_table_name(SHARD)


@pytest.fixture(autouse=True)
def data(tmp_path, monkeypatch) -> Path:
    """The data folder, empty at first."""
    monkeypatch.setenv("ICRL4AHT_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.delenv("ICRL4AHT_REMOTE", raising=False)
    return tmp_path / "data"


def flip(path: Path, position: int = -2) -> None:
    content = bytearray(path.read_bytes())
    content[position] ^= 1
    path.write_bytes(content)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def batch(root, **options):
    return load_icrl4aht(root, layout="coord_simple", **options).ad(batch_size=8, length=30)[0]


# Mirrors


@pytest.mark.parametrize("change", [flip, cut, empty])
@pytest.mark.parametrize("name", [INFO, HISTORIES, "meta/tasks.jsonl", "meta/provenance.json", TABLE, SHARD])
def test_a_changed_mirror_is_fetched_again(lite, name, change, monkeypatch):
    expected = batch(lite[0])
    with http_server(lite[0]) as server:
        plan = plan_download(server.url)
        fetch_planned(plan)
        mirror, intact = plan.root.folder, (lite[0] / name).read_bytes()
        change(mirror / name)
        if name != SHARD:
            monkeypatch.setenv("ICRL4AHT_OFFLINE", "1")
            with pytest.raises(OfflineError, match=rf"not downloaded, or changed since: {name}"):
                batch(server.url)
            monkeypatch.delenv("ICRL4AHT_OFFLINE")
        for cache in ("stream", "ram"):
            assert_equal(batch(server.url, cache=cache), expected)
        assert (mirror / name).read_bytes() == intact or (name == SHARD and change is flip)


@pytest.mark.parametrize("name", [INFO, HISTORIES, TABLE])
def test_a_changed_file_in_the_cache_of_the_hub_is_fetched_again(lite, tmp_path, name):
    expected = batch(lite[0])
    with hub_server(tmp_path / "hub") as hub:
        hub.add_repo("org/name", lite[0])
        url = "hf://datasets/org/name"
        assert_equal(batch(url), expected)
        path = load_icrl4aht(url).root / name
        flip(path.resolve())
        assert_equal(batch(url), expected)
        assert path.read_bytes() == (lite[0] / name).read_bytes()


def test_the_noted_version_of_an_address_leads_nowhere_else(lite, data, monkeypatch):
    with http_server(lite[0]) as server:
        folder = load_icrl4aht(server.url).root
        (folder.parent / "latest").write_text("../../elsewhere")
        assert load_icrl4aht(server.url).root == folder
        monkeypatch.setenv("ICRL4AHT_OFFLINE", "1")
        assert load_icrl4aht(server.url).root == folder
        with (folder / MANIFEST).open("a") as stream:
            stream.write(f"{'0' * 64}  LICENSE\n")
        with pytest.raises(OfflineError, match=r"MANIFEST\.sha256: changed since it was downloaded"):
            load_icrl4aht(server.url)


def forged_chunk(rows: np.ndarray, number: int, stored: bytes) -> bytes:
    """Other bytes of the same size and CRC-32, which begin with a chunk that inflates to as many bytes, all 3."""
    size, crc = int(rows["size"][number]), int(rows["crc32"][number])
    length = len(zlib.decompress(stored))
    data = bytearray(zlib.compress(bytes([3]) * length, 9).ljust(size, b"\0"))
    basis: dict[int, tuple[int, int]] = {}  # CRC-32 is linear: the last four bytes are found by elimination
    base = zlib.crc32(bytes(data))
    for bit in range(32):
        trial = bytearray(data)
        trial[size - 4 + bit // 8] ^= 1 << bit % 8
        vector, mask = zlib.crc32(bytes(trial)) ^ base, 1 << bit
        while vector and (top := vector.bit_length()) in basis:
            vector, mask = vector ^ basis[top][0], mask ^ basis[top][1]
        if vector:
            basis[vector.bit_length()] = vector, mask
    rest, chosen = base ^ crc, 0
    while rest:
        vector, mask = basis[rest.bit_length()]
        rest, chosen = rest ^ vector, chosen ^ mask
    for bit in range(32):
        data[size - 4 + bit // 8] ^= (chosen >> bit & 1) << bit % 8
    assert zlib.crc32(bytes(data)) == crc
    return bytes(data)


def test_a_server_with_true_tables_and_other_shards_is_refused(lite, tmp_path):
    root = tmp_path / "forged"
    shutil.copytree(lite[0], root)
    rows, shard = np.load(root / TABLE), root / SHARD
    content = bytearray(shard.read_bytes())
    for number in np.flatnonzero(rows["rows"]).tolist():
        offset, size = int(rows["offset"][number]), int(rows["size"][number])
        stored = bytes(content[offset : offset + size])
        if size > len(zlib.compress(bytes(len(zlib.decompress(stored))), 9)) + 4:
            content[offset : offset + size] = forged_chunk(rows, number, stored)
    assert content != shard.read_bytes()
    shard.write_bytes(content)
    with http_server(root) as server:
        for cache in ("stream", "ram"):
            with pytest.raises(RemoteError, match=r"expected blake2b \w+, found \w+, 3 times"):
                load_icrl4aht(server.url, layout="coord_simple", cache=cache).ad(batch_size=8, length=30)[0]
        with pytest.raises(RemoteError, match="expected blake2b"):
            fetch_planned(plan_download(server.url, to=tmp_path / "mine", retry=QUICK))
    assert not (tmp_path / "mine" / SHARD).exists()


# Downloads that are run again, and where they write


@pytest.mark.parametrize("change", [flip, cut, Path.unlink])
@pytest.mark.parametrize("kind", ["http", "hub"])
def test_a_finished_download_that_is_run_again_compares_the_files(lite, tmp_path, kind, change):
    target, names = tmp_path / "mine", [SHARD, HISTORIES, "README.md", TABLE]
    with http_server(lite[0]) as http, hub_server(tmp_path / "hub") as hub:
        hub.add_repo("org/name", lite[0])
        command = ["download", http.url if kind == "http" else "hf://datasets/org/name", "--to", str(target)]
        CliRunner().invoke(cli, command, catch_exceptions=False)
        files = len([path for path in target.rglob("*") if path.is_file()]) - 1
        again = CliRunner().invoke(cli, command).output
        assert f"0 files, 0 bytes downloaded; {files} files present already, with the right hashes" in again
        for name in names:
            change(target / name)
        lines = CliRunner().invoke(cli, command, catch_exceptions=False).output.splitlines()
        replaced = [line.split(":")[0] for line in lines if "had changed, was fetched again" in line]
        assert sorted(replaced) == sorted([] if change is Path.unlink else names)
    assert {name: (target / name).read_bytes() for name in names} == {n: (lite[0] / n).read_bytes() for n in names}
    assert verify_release(target).ok
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "hub", "mine"], "no locks, no partial folder"


def test_comparing_shows_progress(lite, tmp_path):
    with http_server(lite[0]) as server:
        fetch_planned(plan_download(server.url, to=tmp_path / "mine"))
        seen: list[tuple[str, int, int]] = []
        plan = plan_download(server.url, to=tmp_path / "mine", advance=lambda *step: seen.append(step))
    total = sum(plan.files.values())
    assert seen[-1] == ("compare", total, total) and len(seen) == len(plan.files)


def test_changed_files_of_a_folder_from_elsewhere_are_not_overwritten(lite, tmp_path):
    target = tmp_path / "mine"
    shutil.copytree(lite[0], target)
    with http_server(lite[0]) as server:
        fetch_planned(plan_download(server.url, to=target))  # complete: there is nothing to do
        shutil.rmtree(tmp_path / "data")
        for name in ("README.md", INFO):
            flip(target / name)
            before = (target / name).read_bytes()
            with pytest.raises(OptionError, match=rf"{name}: not as its MANIFEST.*verify .* --repair --from http"):
                plan_download(server.url, to=target)
            assert (target / name).read_bytes() == before
            shutil.copyfile(lite[0] / name, target / name)


def test_a_folder_with_other_content_is_refused(lite, full, tmp_path):
    target = tmp_path / "home"
    target.mkdir()
    (target / ".bashrc").write_text("mine")
    with http_server(lite[0]) as server:
        result = CliRunner().invoke(cli, ["download", server.url, "--to", str(target)])
        assert result.exit_code == 1 and "not empty, and not a release" in str(result.exception)
        assert [path.name for path in target.iterdir()] == [".bashrc"]
        shutil.rmtree(target)
        shutil.copytree(full[0], target)
        with pytest.raises(OptionError, match="holds another release or version"):
            plan_download(server.url, to=target)
        shutil.rmtree(target)
        shutil.copytree(lite[0], target)
        (target / "meta" / "my.txt").write_text("mine")
        with pytest.raises(OptionError, match=r"my\.txt: not a file of this release: move it elsewhere"):
            plan_download(server.url, to=target)
        shutil.rmtree(target)
        target.mkdir()
        fetch_planned(plan_download(server.url, to=target))
        (target / MANIFEST).write_text("nonsense\n")
        fetch_planned(plan_download(server.url, to=target))
        assert verify_release(target).ok


def link_elsewhere(partial: Path, elsewhere: Path) -> None:
    partial.symlink_to(elsewhere)


def link_of_a_folder(partial: Path, elsewhere: Path) -> None:
    partial.mkdir()
    (partial / "data").symlink_to(elsewhere)


def link_of_a_file(partial: Path, elsewhere: Path) -> None:
    (partial / SHARD).parent.mkdir(parents=True)
    (partial / SHARD).symlink_to(elsewhere / "victim")


def foreign_file(partial: Path, elsewhere: Path) -> None:
    partial.mkdir()
    (partial / "thesis.tex").write_text("mine")


def a_file(partial: Path, elsewhere: Path) -> None:
    partial.write_text("mine")


def a_pipe(partial: Path, elsewhere: Path) -> None:
    (partial / "meta").mkdir(parents=True)
    os.mkfifo(partial / HISTORIES)


PREPARED = [link_elsewhere, link_of_a_folder, link_of_a_file, foreign_file, a_file, a_pipe]


@pytest.mark.parametrize("prepare", PREPARED)
def test_a_prepared_folder_for_unfinished_files_is_refused(lite, tmp_path, prepare: Callable[[Path, Path], None]):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "victim").write_text("keep me")
    prepare(tmp_path / "mine.partial", elsewhere)
    with http_server(lite[0]) as server, pytest.raises(OptionError, match=r"mine\.partial"):
        fetch_planned(plan_download(server.url, to=tmp_path / "mine"))
    assert [path.name for path in elsewhere.iterdir()] == ["victim"]
    assert (elsewhere / "victim").read_text() == "keep me"


@pytest.mark.parametrize("kind", ["http", "hub"])
def test_nothing_unfinished_is_left_in_the_mirrors(lite, tmp_path, data, kind):
    with http_server(lite[0]) as http, hub_server(tmp_path / "hub") as hub:
        hub.add_repo("org/name", lite[0])
        url = http.url if kind == "http" else "hf://datasets/org/name"
        batch(url, cache="stream")
        assert list(data.glob("*/*.partial")), "parts of shards are kept while they are not complete"
        fetch_planned(plan_download(url))
    assert not [path for path in data.rglob("*") if path.name.endswith((".partial", ".lock"))]


# Notes of other people


def test_a_note_in_a_release_steers_nothing(lite, tmp_path):
    root = tmp_path / "unpacked"
    shutil.copytree(lite[0], root)
    (root / SHARD).unlink()
    with http_server(lite[0]) as server:
        (root / ".origin.json").write_text(json.dumps({"url": server.url, "files": []}))
        assert verify_release(root).files_at_fault == {SHARD, ".origin.json"}, "a missing file is not hidden"
        with pytest.raises(OptionError, match="needs the address of a complete copy, found None: give --from"):
            repair(root, [SHARD])
        assert not server.log


def test_a_note_is_about_one_folder_and_release(lite, full, tmp_path, data):
    target = tmp_path / "mine"
    with http_server(lite[0]) as server:
        fetch_planned(plan_download(server.url, to=target, layout="demo_wide"))
        assert verify_release(target).ok, "the other shard was not requested"
        shutil.copytree(target, tmp_path / "copy")
        assert verify_release(tmp_path / "copy").files_at_fault == {SHARD, TABLE}
        shutil.rmtree(target)
        shutil.copytree(full[0], target)
        (target / SHARD).unlink()
        assert SHARD in verify_release(target).files_at_fault, "another release lies there now"
    for note in data.glob("downloads/*.json"):
        note.write_text('{"folder": 3}')
    assert SHARD in verify_release(target).files_at_fault


# Redirects


@pytest.fixture
def other(lite):
    """A server on another port, with the same files."""
    with http_server(lite[0]) as server:
        yield server


@pytest.mark.parametrize("path", ["*/MANIFEST.sha256", f"*/{INFO}", "*.h5"])
@pytest.mark.parametrize("code", [301, 302, 303, 307, 308])
def test_a_redirect_to_another_host_is_refused(lite, other, path, code, monkeypatch):
    monkeypatch.delenv(REDIRECT_VARIABLE, raising=False)
    with http_server(lite[0]) as server:
        signed = f"{other.url}/{SHARD if path == '*.h5' else path[2:]}?X-Amz-Signature=secret"
        server.faults.every(1, Redirect(signed, code), path=path, method=None)
        with pytest.raises(RemoteError, match=rf"redirects to http.*refused.*{REDIRECT_VARIABLE}=127") as caught:
            load_icrl4aht(server.url, cache="stream")[0].actions[:]
    assert "secret" not in str(caught.value)
    assert not other.log, "the other host was not asked"


def test_a_redirect_that_the_user_allows_is_followed(lite, other, monkeypatch):
    monkeypatch.setenv(REDIRECT_VARIABLE, "example.org, 127.0.0.*")
    with http_server(lite[0]) as server:
        server.faults.every(1, Redirect(f"{other.url}/{SHARD}?X-Amz-Signature=x"), path="*.h5", method=None)
        assert_equal(batch(server.url, cache="stream"), batch(lite[0]))
    assert other.log


def test_a_redirect_to_another_path_of_the_host_is_followed(lite):
    with http_server(lite[0]) as server:
        server.faults.next(Redirect(f"/{INFO}"), path=f"/{INFO}", method=None)
        assert_equal(batch(server.url), batch(lite[0]))


@pytest.mark.parametrize(("target", "message"), [(f"/{MANIFEST}", "TooManyRedirects"), ("http:///x", "Invalid")])
def test_redirects_that_lead_nowhere_are_not_retried(lite, target, message):
    with http_server(lite[0]) as server:
        server.faults.every(1, Redirect(target), method=None)
        with pytest.raises(RemoteError, match=message) as caught:
            load_icrl4aht(server.url)
    assert "attempts" not in str(caught.value)


def test_an_invalid_url_is_not_retried():
    with pytest.raises(RemoteError, match=r"(?i)InvalidUrl") as caught:
        Store("http:///x", QUICK).size("a")
    assert "attempts" not in str(caught.value)


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        ("https://a.test/x", "https://a.test/y", None),
        ("http://a.test/x", "https://a.test/x", None),
        ("https://a.test/x", "https://allowed.test/x?sig=secret", None),
        ("https://a.test/x", "http://a.test/x", "only https is safe"),
        ("https://a.test/x", "http://allowed.test/x", "only https is safe"),
        ("https://a.test/x", "https://a.test:8443/x", "another host"),
        ("https://a.test/x", "https://b.test/x?sig=secret", "another host"),
        ("https://a.test/x", "https://user:secret@b.test/x", "another host"),
        ("https://a.test/x", "file:///etc/passwd", "expected http"),
        ("https://a.test/x", "https:///x", "expected http"),
        ("http://a.test/x", "http://127.0.0.1:8080/x", "refused: that is an address of this machine"),
        ("http://127.0.0.1/x", "http://127.0.0.1:8080/x", "another host"),
        ("http://a.test/x", "http://metadata.test/x", "this machine or of its local network"),
        ("http://a.test/x", "http://loop.test/x", "this machine or of its local network"),
        ("http://a.test/x", "http://mapped.test/x", "this machine or of its local network"),
        ("http://loop.test/x", "http://metadata.test/x", None),
    ],
)
def test_which_redirects_are_followed(source, target, message, monkeypatch):
    found = {"metadata.test": "169.254.169.254", "loop.test": "127.0.0.1", "mapped.test": "::ffff:127.0.0.1"}
    allowed = f"allowed.test,{','.join(found)}"
    found["127.0.0.1"] = "127.0.0.1"

    def look_up(host, port, **options):
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (found.get(host, "93.184.216.34"), 0))]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    monkeypatch.setenv(REDIRECT_VARIABLE, allowed)
    if message is None:
        check_redirect(source, target)
        return
    with pytest.raises(RemoteError, match=message) as caught:
        check_redirect(source, target)
    assert "secret" not in str(caught.value)


def test_the_hub_does_not_send_readers_to_this_machine(lite, monkeypatch):
    found = {"hub.test": "93.184.216.34", "cdn.test": "93.184.216.35", "evil.test": "127.0.0.1"}
    look_up = lambda host, port, **options: [(2, 1, 6, "", (found[host], 0))]  # noqa: E731
    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    check_redirect("https://hub.test/x", "https://cdn.test/y?sig=1", trusted=True)
    for target in ("https://evil.test/x", "http://cdn.test/x"):
        with pytest.raises(RemoteError, match="refused"):
            check_redirect("https://hub.test/x", target, trusted=True)


# Credentials


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("https://u:p@h.test/a?token=t", "https://h.test/a"),
        ("GET https://u:p@h.test:8/a?x=1&y=2, then", "GET https://h.test:8/a then"),
        ("url='http://me@h.test/a#t'", "url='http://h.test/a'"),
        ("hf://datasets/org/name@v1", "hf://datasets/org/name@v1"),
        ("s3://key:secret@bucket/x", "s3://bucket/x"),
        ("https://u:p@ss@h.test/a@b", "https://h.test/a@b"),
        ("a folder?", "a folder?"),
    ],
)
def test_texts_without_credentials(text, expected):
    assert without_credentials(text) == expected


SECRETS = ("hunter2", "t0ken")


@pytest.mark.parametrize(
    "address",
    [
        "http://user:hunter2/RET@127.0.0.1:9/x",
        "http://user:1/hunter2@127.0.0.1:9/x",
        "http://user:/hunter2@127.0.0.1:9/x",
        "https://u:p@s/hunter2@h.test/x",
        "https://u:hunter2?x@h.test/x",
        "https://u:hunter2#x@h.test/x",
        "https://u:p hunter2@h.test/x",
        "https://u:p'hunter2@h.test/x",
        "https://u:p<hunter2@h.test/x",
        "https://h.test:80800/hunter2",
        "s3://AKIA:ab/hunter2+ef@bucket/x",
        "simplecache::https://u:p/hunter2@h.test/x",
    ],
)
def test_credentials_that_are_not_encoded_are_refused_unseen(address, monkeypatch, caplog):
    monkeypatch.setenv("ICRL4AHT_REMOTE", address)
    attempts = [lambda: load_icrl4aht(address), lambda: verify_release(address), lambda: plan_download(address)]
    for attempt in attempts:
        with pytest.raises(OptionError, match="percent-encode the user name and password") as caught:
            attempt()
        assert "hunter2" not in " ".join(errors(caught.value))
    output = CliRunner().invoke(cli, ["doctor", "--json"]).output
    assert "percent-encode" in output and "hunter2" not in output + " ".join(caplog.messages)


@pytest.mark.parametrize(
    "address",
    [
        "hf://datasets/you/icrl4aht@v0.4.0",
        "https://h.test/icrl4aht@v1",
        "http://127.0.0.1:8000/icrl4aht@v1",
        "http://[::1]:8000/icrl4aht@v1",
        "https://u:p%2F%40@h.test:8/x?mail=a:b@c",
        "https://me@h.test/x",
        "s3://bucket/x@1",
    ],
)
def test_addresses_that_may_be_opened(address):
    assert Store(address).url.startswith(address[:4])


def guarded(folder: Path, seen: list[str]) -> Server:
    """A server of a folder's files that answers 401 without user, password and token."""

    def route(request, body) -> Answer:
        allowed = request.headers["Authorization"] == "Basic bWU6aHVudGVyMg==" and request.target.endswith("?key=t0ken")
        seen.append(request.target)
        path = folder / request.path.lstrip("/")
        if not path.is_file():
            return Answer(b"", 404)
        return Answer(path, etag='"x"') if allowed else Answer(b"", 401)

    return Server(route)


def test_credentials_in_an_address_are_used_and_never_kept_or_shown(lite, tmp_path, monkeypatch, caplog):
    target, said = tmp_path / "mine", []
    for name in ("fsspec.http", "aiohttp.client"):
        caplog.set_level("DEBUG", logger=name)
    server = guarded(lite[0], [])
    url = f"{server.url.replace('http://', 'http://me:hunter2@')}?key=t0ken"
    monkeypatch.setenv("ICRL4AHT_REMOTE", url)
    try:
        assert_equal(batch(url, cache="stream"), batch(lite[0]))
        said += [repr(load_icrl4aht(url)), str(load_icrl4aht(url).origin)]
        commands = [["download", "--to", str(target)], ["download", "--dry-run", "--json"], ["show", url]]
        commands += [["verify", url], ["doctor", "--json"], ["list", url], ["verify", str(target), "--repair"]]
        for command in commands:
            if "--repair" in command:
                cut(target / SHARD)
            result = CliRunner().invoke(cli, command)
            assert result.exit_code in (0, 1 if "doctor" in command else 0), result.output
            said.append(result.output)
        assert verify_release(target).ok
        server.faults.every(1, Status(503), method=None)
        with pytest.raises(RemoteError, match="503") as caught:
            plan_download(url, retry=RetryPolicy(attempts=2, first_wait=2.0, longest_wait=0.01))
        said += errors(caught.value)
        server.faults.clear()
        server.faults.every(1, Redirect(f"http://u:hunter2@nowhere.test/{MANIFEST}?t0ken"), method=None)
        with pytest.raises(RemoteError, match="another host") as caught:
            load_icrl4aht(url)
        said += errors(caught.value)
        server.faults.clear()
        with pytest.raises(RootNotFoundError) as caught:
            load_icrl4aht(url.replace("?", "/nowhere?"))
        said += errors(caught.value)
        with pytest.raises(RemoteError) as caught:
            load_icrl4aht(url.replace("hunter2", "hunter2x"))
        said += errors(caught.value)
    finally:
        server.close()
    with pytest.raises(OptionError) as caught:
        Store("nonsense://me:hunter2@x?t0ken").size("a")
    assert str(caught.value).startswith("nonsense://x: not an address that fsspec opens: ")
    said += [*errors(caught.value), caplog.text]
    assert "Retrieve file size for http://127.0.0.1" in caplog.text
    for path in tmp_path.rglob("*"):
        said.append(str(path.relative_to(tmp_path)))
        if path.is_file():
            said.append(path.read_bytes().decode(errors="replace"))
    assert not [text for text in said if any(secret in text for secret in SECRETS)]


def errors(error: BaseException | None) -> list[str]:
    """The messages that a traceback shows."""
    said = []
    while error is not None:
        said += [str(error), repr(error)]
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return said


# The API of the Hub


@pytest.mark.parametrize("path", ["*/tree/*", "*/revision/*"])
def test_endless_answers_of_the_hub_are_cut(lite, tmp_path, monkeypatch, path):
    monkeypatch.setattr("icrl4aht_data.remote.hub.TEXT_BYTES", 10_000)
    with hub_server(tmp_path / "hub") as hub:
        hub.add_repo("org/name", lite[0])
        serve = hub._server.route
        large = Answer(json.dumps([" " * 20_000]).encode(), headers={"Content-Type": "application/json"})

        def route(request, body) -> Answer:
            return large if fnmatchcase(request.path, path) else serve(request, body)

        hub._server.route = route
        with pytest.raises(RemoteError, match="expected at most 10,000 bytes from the Hub's API, and more came"):
            load_icrl4aht("hf://datasets/org/name")

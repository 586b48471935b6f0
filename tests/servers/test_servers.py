"""The servers that tests of remote data rely on, against the clients that users have."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from http.client import HTTPConnection, HTTPResponse, IncompleteRead
from pathlib import Path
from urllib.parse import urlsplit

import fsspec
import numpy as np
import pytest

from tests.servers.common import (
    Cut,
    Etag,
    Fault,
    Faults,
    Flip,
    IgnoreRange,
    Long,
    Redirect,
    Request,
    Server,
    Short,
    Slow,
    Status,
    forget_filesystems,
    http_server,
    s3_server,
)

DATA = np.random.default_rng(0).bytes(200_000)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Files to serve. Read only."""
    root = tmp_path_factory.mktemp("served")
    (root / "shards").mkdir()
    (root / "shards" / "a b.h5").write_bytes(DATA)
    (root / "empty").write_bytes(b"")
    (root.parent / "secret").write_bytes(b"secret")
    return root


@pytest.fixture
def web(folder) -> Iterator[Server]:
    with http_server(folder) as server:
        yield server
    forget_filesystems("http")


def get(
    server: Server | str, path: str, method: str = "GET", body: bytes = b"", **headers: str
) -> tuple[HTTPResponse, bytes]:
    """One request without a client's repairs. IncompleteRead where the body is cut."""
    url = server if isinstance(server, str) else server.url
    connection = HTTPConnection(urlsplit(url).netloc, timeout=10)
    try:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, body, named)
        response = connection.getresponse()
        return response, response.read()
    finally:
        connection.close()


SHARD = "/shards/a%20b.h5"


@pytest.mark.parametrize(
    ("asked", "start", "stop"),
    [("bytes=0-0", 0, 1), ("bytes=5-9", 5, 10), ("bytes=199990-", 199_990, 200_000), ("bytes=-7", 199_993, 200_000)],
)
def test_ranges(web, asked, start, stop):
    response, body = get(web, SHARD, Range=asked)
    assert (response.status, body) == (206, DATA[start:stop])
    assert response.headers["Content-Range"] == f"bytes {start}-{stop - 1}/200000"
    entry = web.log[-1]
    assert (entry.method, entry.path, entry.start, entry.stop) == ("GET", "/shards/a b.h5", start, stop)
    assert (entry.status, entry.sent) == (206, stop - start)


def test_a_whole_file_and_its_headers(web):
    whole, body = get(web, SHARD)
    head, nothing = get(web, SHARD, "HEAD")
    assert (whole.status, head.status, body, nothing) == (200, 200, DATA, b"")
    for name in ("ETag", "Last-Modified", "Content-Length", "Accept-Ranges"):
        assert whole.headers[name] == head.headers[name]
    assert [(entry.method, entry.start, entry.sent) for entry in web.log] == [("GET", None, 200_000), ("HEAD", None, 0)]
    assert get(web, "/empty")[1] == b""


def test_conditions(web):
    etag = get(web, SHARD, "HEAD")[0].headers["ETag"]
    assert get(web, SHARD, If_None_Match=etag)[0].status == 304
    assert get(web, SHARD, If_Match='"other"')[0].status == 412
    assert get(web, SHARD, If_Range=etag, Range="bytes=1-2")[1] == DATA[1:3]
    assert get(web, SHARD, If_Range='"other"', Range="bytes=1-2")[1] == DATA


@pytest.mark.parametrize(
    ("path", "status"), [("/", 404), ("/shards", 404), ("/none", 404), ("/../secret", 404), ("/%2e%2e/secret", 404)]
)
def test_no_listing_and_nothing_outside(web, path, status):
    assert get(web, path)[0].status == status


def test_past_the_end(web):
    response, _ = get(web, SHARD, Range="bytes=200000-")
    assert (response.status, response.headers["Content-Range"]) == (416, "bytes */200000")
    assert get(web, "/empty", Range="bytes=0-")[0].status == 416


def test_fsspec_reads_over_http(web):
    filesystem = fsspec.filesystem("http")
    url = f"{web.url}/shards/a b.h5"
    assert filesystem.cat_file(url) == DATA
    assert filesystem.cat_file(url, start=1000, end=1500) == DATA[1000:1500]
    assert filesystem.info(url)["size"] == len(DATA)
    with filesystem.open(url, block_size=4096) as file:
        file.seek(150_000)
        assert file.read(100) == DATA[150_000:150_100]
    with pytest.raises(FileNotFoundError):
        filesystem.cat_file(f"{web.url}/none")


FAULTS = pytest.mark.parametrize(
    ("fault", "status", "body"),
    [
        (Status(429, {"Retry-After": "1"}), 429, b"as the test ordered\n"),
        (Short(3), 206, DATA[10:17]),
        (Long(3), 206, DATA[10:23]),
        (Flip(2), 206, DATA[10:12] + bytes([DATA[12] ^ 255]) + DATA[13:20]),
        (Flip(-1), 206, DATA[10:19] + bytes([DATA[19] ^ 255])),
        (IgnoreRange(), 200, DATA),
        (Redirect("/empty"), 302, b""),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Fault) else "",
)


def check_fault(server: Server | str, path: str, fault: Fault, status: int, body: bytes) -> None:
    """What was ordered comes once, for the range 10-19."""
    response, found = get(server, path, Range="bytes=10-19")
    assert (response.status, found) == (status, body)
    assert response.headers["Content-Length"] == str(len(body))
    if isinstance(fault, Status):
        assert response.headers["Retry-After"] == "1"
    if isinstance(fault, Redirect):
        assert response.headers["Location"] == "/empty"
    assert get(server, path, Range="bytes=10-19")[1] == DATA[10:20]


@FAULTS
def test_faults_of_a_range(web, fault: Fault, status, body):
    web.faults.next(fault)
    check_fault(web, SHARD, fault, status, body)


def test_a_body_longer_than_its_file_ends_in_zeros(web):
    web.faults.next(Long(4))
    response, body = get(web, SHARD)
    assert (body, response.headers["Content-Length"]) == (DATA + bytes(4), "200004")


def test_a_cut_body(web):
    web.faults.next(Cut(70_000))
    with pytest.raises(IncompleteRead) as caught:
        get(web, SHARD)
    assert caught.value.partial == DATA[:70_000]
    assert (web.log[-1].status, web.log[-1].sent) == (200, 70_000)


def test_a_slow_body(web):
    web.faults.next(Slow(0.1, bytes_per_second=50_000))
    began = time.monotonic()
    assert get(web, SHARD, Range="bytes=0-9999")[1] == DATA[:10_000]
    assert time.monotonic() - began > 0.25


def test_closing_does_not_wait_for_a_slow_body(folder):
    began = time.monotonic()
    with http_server(folder, Faults(lambda request: Slow(60))) as server:
        connection = HTTPConnection(urlsplit(server.url).netloc)
        connection.request("GET", SHARD)
        while not server.log:
            time.sleep(0.01)
    connection.close()
    assert time.monotonic() - began < 30


def test_another_etag_from_now_on(web):
    before = get(web, SHARD, "HEAD")[0].headers["ETag"]
    web.faults.next(Etag("other"))
    found = [get(web, SHARD)[0].headers["ETag"] for _ in range(2)]
    assert before not in found
    assert found == ['"other"', '"other"']
    assert get(web, SHARD, If_Match=before)[0].status == 412


def test_rules_are_asked_in_their_order(web):
    web.faults.every(3, Status(503), path="/shards/*")
    web.faults.next(Status(500), times=2, path="*.h5", method="HEAD")
    found = [get(web, SHARD)[0].status for _ in range(4)] + [get(web, SHARD, "HEAD")[0].status for _ in range(3)]
    assert found == [200, 200, 503, 200, 500, 500, 200]
    web.faults.clear()
    web.faults.add(lambda request: Status(403) if request.headers.get("Range") else None)
    assert [get(web, SHARD)[0].status, get(web, SHARD, Range="bytes=0-1")[0].status] == [200, 403]


def test_the_servers_own_errors_reach_the_test():
    def route(request: Request, body: bytes):
        raise KeyError("a bug")

    server = Server(route)
    with pytest.raises(ConnectionError):
        get(server, "/")
    with pytest.raises(KeyError, match="a bug"):
        server.close()


def test_fsspec_reads_a_bucket(folder):
    with s3_server(folder) as bucket:
        filesystem = fsspec.filesystem("s3")
        url = f"{bucket.url}/shards/a b.h5"
        assert bucket.keys() == ["empty", "shards/a b.h5"]
        assert sorted(filesystem.find(bucket.url)) == ["data/empty", "data/shards/a b.h5"]
        assert filesystem.cat_file(url) == DATA
        assert filesystem.cat_file(url, start=1000, end=1500) == DATA[1000:1500]
        bucket.put("shards/a b.h5", b"new")
        filesystem.invalidate_cache()
        assert filesystem.cat_file(url) == b"new"
        bucket.delete("shards/a b.h5")
        filesystem.invalidate_cache()
        with pytest.raises(FileNotFoundError):
            filesystem.cat_file(url)
    with s3_server(folder / "shards", "other") as bucket:
        assert bucket.keys() == ["a b.h5"]
        assert fsspec.filesystem("s3").ls("other") == ["other/a b.h5"]


@pytest.mark.parametrize("head", [b"Content-Length: 10", b"Transfer-Encoding: chunked"])
def test_a_client_that_dies_before_its_body_has_asked_nothing(tmp_path, head):
    with http_server(tmp_path) as server:
        with socket.create_connection(("127.0.0.1", server.server_address[1])) as client:
            client.sendall(b"POST /file HTTP/1.1\r\nHost: here\r\n" + head + b"\r\n\r\n")
        client.close()
    assert server.log == []

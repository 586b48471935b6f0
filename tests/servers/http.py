"""An HTTP server on 127.0.0.1 that can inject faults, and a function that serves the files of a folder."""

from __future__ import annotations

import io
import os
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, BinaryIO, cast
from urllib.parse import unquote, urlsplit

from tests.servers.faults import (
    ErrorStatus,
    Fault,
    Faults,
    FlippedByte,
    LongBody,
    Redirect,
    Request,
    ShortBody,
    SlowAnswer,
    TruncatedBody,
)

BLOCK = 1 << 16
PACE = 0.02  # seconds between blocks if a body is sent slowly


@dataclass(frozen=True)
class Answer:
    """The HTTP response that a route returns.

    Args:
        body: content of the response, or the path of a file with the content.
        status: HTTP status of the response.
        headers: headers of the response except Content-Length.
    """

    body: bytes | Path = b""
    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)


Route = Callable[[Request, bytes], Answer]


class Server(ThreadingHTTPServer):
    """HTTP server that answers with a given function, logs every request, and injects configured faults."""

    request_queue_size = 128

    def __init__(self, route: Route, faults: Faults | None = None, log: list[Request] | None = None) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.route = route
        self.faults = Faults() if faults is None else faults
        self.log: list[Request] = [] if log is None else log
        self.url = f"http://127.0.0.1:{self.server_address[1]}"
        self.closing = threading.Event()
        self._errors: list[BaseException] = []
        self._open: dict[Any, threading.Thread] = {}
        self._serving = threading.Thread(target=self.serve_forever, args=(0.02,), daemon=True)
        self._serving.start()

    def process_request(self, request, client_address) -> None:
        thread = threading.Thread(target=self.process_request_thread, args=(request, client_address), daemon=True)
        self._open[request] = thread
        thread.start()

    def shutdown_request(self, request) -> None:
        super().shutdown_request(request)
        self._open.pop(request, None)

    def handle_error(self, request, client_address) -> None:
        error = sys.exception()
        if error is not None and not isinstance(error, ConnectionError):
            self._errors.append(error)

    def close(self) -> None:
        """Close all connections and end all threads; raise the first error that happened inside the server."""
        self.closing.set()
        self.shutdown()
        self._serving.join()
        self.server_close()
        for connection, thread in list(self._open.items()):
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            thread.join()
        if self._errors:
            raise self._errors[0]


class Handler(BaseHTTPRequestHandler):
    """Answer the requests of one connection."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    @property
    def test_server(self) -> Server:
        return cast(Server, self.server)

    def log_message(self, format: str, *args) -> None:
        pass

    def answer(self) -> None:
        body = self._read(int(self.headers.get("Content-Length") or 0))
        path = unquote(urlsplit(self.path).path)
        request = Request(self.command, path, self.path, self.headers)
        fault = self.test_server.faults(request)
        self.test_server.log.append(request)
        if isinstance(fault, SlowAnswer):
            self.test_server.closing.wait(fault.delay)
        if isinstance(fault, ErrorStatus):
            answer = Answer(b"error requested by the test\n", fault.code, fault.headers)
        elif isinstance(fault, Redirect):
            answer = Answer(b"", 302, {"Location": fault.to})
        else:
            answer = self.test_server.route(request, body)
        self._send(request, answer, fault)

    do_GET = do_HEAD = do_POST = do_PUT = do_DELETE = answer

    def _read(self, size: int) -> bytes:
        """Return the complete body of a request; raise ConnectionAbortedError if the client sends less."""
        found = self.rfile.read(size)
        if len(found) < size:
            raise ConnectionAbortedError(f"{self.path}: received {len(found)} of {size} bytes of the request")
        return found

    def _send(self, request: Request, answer: Answer, fault: Fault | None) -> None:
        with _open_body(answer.body) as file:
            size = os.fstat(file.fileno()).st_size if isinstance(answer.body, Path) else len(answer.body)
            if size:
                size += fault.by if isinstance(fault, LongBody) else -fault.by if isinstance(fault, ShortBody) else 0
            request.status, length = answer.status, max(0, size)
            self.send_response(answer.status)
            for name, value in (answer.headers | {"Content-Length": str(length)}).items():
                self.send_header(name, value)
            self.end_headers()
            if self.command != "HEAD":
                self._send_body(request, file, length, fault)

    def _send_body(self, request: Request, file: BinaryIO, length: int, fault: Fault | None) -> None:
        pace = fault.bytes_per_second if isinstance(fault, SlowAnswer) else None
        most = BLOCK if pace is None else max(1, int(pace * PACE))
        flipped = fault.position % length if isinstance(fault, FlippedByte) and length else -1
        end = min(length, fault.after) if isinstance(fault, TruncatedBody) else length
        self.close_connection |= isinstance(fault, TruncatedBody)
        while request.sent < end:
            count = min(most, end - request.sent)
            block = bytearray(file.read(count).ljust(count, b"\0"))
            if 0 <= flipped - request.sent < count:
                block[flipped - request.sent] ^= 0xFF
            request.sent += count
            self.wfile.write(block)
            if pace is not None and self.test_server.closing.wait(count / pace):
                self.close_connection = True
                return


def _open_body(body: bytes | Path) -> BinaryIO:
    return body.open("rb") if isinstance(body, Path) else io.BytesIO(body)


@contextmanager
def http_server(folder: Path, faults: Faults | None = None) -> Iterator[Server]:
    """Serve the files of a folder, without directory listings; yield the server."""
    root = folder.resolve()

    def route(request: Request, body: bytes) -> Answer:
        if request.method not in ("GET", "HEAD"):
            return Answer(b"GET and HEAD only\n", 405)
        path = (root / request.path.replace("\0", "").lstrip("/")).resolve()
        if not path.is_relative_to(root) or not path.is_file():
            return Answer(b"not found\n", 404)
        return Answer(path)

    server = Server(route, faults)
    try:
        yield server
    finally:
        server.close()

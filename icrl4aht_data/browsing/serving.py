"""Local web server for one page."""

from __future__ import annotations

from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from icrl4aht_data.errors import OptionError

LOOPBACK = "127.0.0.1"
"""Loopback address, which other machines cannot reach."""


def page_server(html: bytes, port: int = 0) -> ThreadingHTTPServer:
    """Return a server of one page on the loopback interface; its `serve_forever` answers requests.

    Args:
        html: the page, served at /; other paths return 404.
        port: the port; 0 chooses a free one, see the server's `server_port`.

    Raises:
        OptionError: if the port cannot be used.
    """

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            found = self.path.partition("?")[0] == "/"
            content = html if found else b"not found\n"
            self.send_response(200 if found else 404)
            self.send_header("Content-Type", "text/html; charset=utf-8" if found else "text/plain; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:
            """Log no requests, since the command prints the address only."""

    try:
        return ThreadingHTTPServer((LOOPBACK, port), Handler)
    except OSError as error:
        raise OptionError(f"port {port}: {error.strerror}; give another one, or 0 for a free one") from error

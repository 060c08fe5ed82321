"""A web server on the loopback interface that fails as told."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class Site:
    """What is served, how, and what was asked for."""

    files: dict[str, bytes] = field(default_factory=dict)  # by path of the URL
    etag: str | None = '"1"'
    last_modified: str | None = None
    has_ranges: bool = True
    heeds_if_range: bool = True
    tells_length: bool = True
    cuts: list[int] = field(default_factory=list)  # bytes of body after which the next answers break off
    statuses: list[int] = field(default_factory=list)  # of the next answers, instead of the file
    requests: list[tuple[str, str | None, str | None]] = field(default_factory=list)  # path, Range, If-Range
    url: str = ""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: _Server

    def do_GET(self) -> None:
        site = self.server.site
        asked, condition = self.headers["Range"], self.headers["If-Range"]
        site.requests.append((self.path, asked, condition))
        self.close_connection = True
        content = site.files.get(self.path)
        if site.statuses:
            self._answer(site.statuses.pop(0), b"")
        elif content is None:
            self._answer(404, b"")
        elif (
            asked is None
            or not site.has_ranges
            or (site.heeds_if_range and condition not in (None, site.etag, site.last_modified))
        ):
            self._answer(200, content)
        else:
            start = int(asked.removeprefix("bytes=").removesuffix("-"))
            if start >= len(content):
                self._answer(416, b"")
            else:
                self._answer(206, content[start:], f"bytes {start}-{len(content) - 1}/{len(content)}")

    def _answer(self, status: int, body: bytes, content_range: str | None = None) -> None:
        site = self.server.site
        self.send_response(status)
        validators = {"ETag": site.etag, "Last-Modified": site.last_modified, "Content-Range": content_range}
        for name, value in validators.items():
            if value is not None:
                self.send_header(name, value)
        if site.tells_length:
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        cut = site.cuts.pop(0) if body and site.cuts else len(body)
        self.wfile.write(body[:cut])

    def log_message(self, *args: object) -> None:
        pass


class _Server(ThreadingHTTPServer):
    def __init__(self, site: Site) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.site = site

    def handle_error(self, request: object, client_address: object) -> None:
        """A client that hangs up is no news."""


@contextmanager
def serve(site: Site) -> Iterator[Site]:
    """Serve ``site`` on a free port, which its ``url`` tells."""
    with _Server(site) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        site.url = f"http://127.0.0.1:{server.server_port}"
        try:
            yield site
        finally:
            server.shutdown()
            thread.join()

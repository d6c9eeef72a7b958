"""A local HTTP server that behaves as badly as it is told to."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class Mirror:
    """What is served, and how."""

    files: dict[str, bytes] = field(default_factory=dict)  # content by path, such as ``/a.zip``
    break_after: int | None = None  # bytes after which each connection is closed
    ranges: bool = True  # whether a part of a file can be asked for
    claimed: int | None = -1  # the size that is claimed; -1 = the real one, None = none at all
    redirect: str = ""  # where every path without it in front leads to
    busy: int = 0  # answers with 503 before the first that is not
    asked: list[str] = field(default_factory=list)  # the Range of every request, "" = none
    address: str = ""


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing of clients that have gone."""


@contextmanager
def serving(mirror: Mirror) -> Iterator[Mirror]:
    server = _Server(("127.0.0.1", 0), handler_of(mirror))
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    mirror.address = f"http://127.0.0.1:{server.server_port}"
    try:
        yield mirror
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def handler_of(mirror: Mirror) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.0"

        def log_message(self, *arguments: object) -> None:
            """Say nothing."""

        def do_GET(self) -> None:
            mirror.asked.append(self.headers.get("Range", ""))
            if mirror.busy:
                mirror.busy -= 1
                self.send_error(503)
            elif mirror.redirect and not self.path.startswith("/moved"):
                self.send_response(302)
                self.send_header("Location", mirror.redirect + self.path)
                self.end_headers()
            elif (content := mirror.files.get(self.path.removeprefix("/moved"))) is None:
                self.send_error(404)
            else:
                self.answer(content)

        def answer(self, content: bytes) -> None:
            tag = f'"{hash(content)}"'
            begin, asked = 0, self.headers.get("Range", "")
            if mirror.ranges and asked and self.headers.get("If-Range") == tag:
                begin = int(asked.removeprefix("bytes=").removesuffix("-"))
                self.send_response(206)
                parts = f"bytes {begin}-{len(content) - 1}/{len(content)}"
                self.send_header("Content-Range", parts)
            else:
                self.send_response(200)
            if mirror.claimed is not None:
                size = len(content) - begin if mirror.claimed < 0 else mirror.claimed
                self.send_header("Content-Length", str(size))
            self.send_header("ETag", tag)
            self.end_headers()
            end = None if mirror.break_after is None else begin + mirror.break_after
            self.wfile.write(content[begin:end])

    return Handler

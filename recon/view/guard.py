"""Who is let into a page that is served on this machine, and what is taken from it.

The pages of any web site, of any other local port, and everybody who has an account here can
connect to a port of 127.0.0.1. So a page has one address, whose path is a secret.
"""

from __future__ import annotations

import asyncio
import gc
import io
import secrets
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import closing, redirect_stdout
from functools import partial
from hmac import compare_digest
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import OutputError, require
from recon.core.machine import return_free_memory

HOST: Final = "127.0.0.1"  # whoever looks is on this machine
MOST_PAGES: Final = 8  # that look at a time: each takes a copy of what is shown
_PART_BYTES: Final = 1 << 18  # of a message, that wait for a page to take them
_PATIENCE_S: Final = 20.0  # for a page that takes nothing, or a stranger that answers nothing
_MESSAGE_BYTES: Final = 1 << 14  # of a page: a camera takes 300
_REFUSED: Final = "this address is not the one that recon printed\n"
#: Before viser's page begins: it would add the address of its server to its own, and unpack what
#: sorts splats, of which there are none here and which needs ``eval``.
_FIRST: Final = """history.replaceState = () => {};
const ask = fetch;
fetch = (url, ...how) =>
  `${url}`.startsWith("data:application/wasm") ? new Promise(() => {}) : ask(url, ...how);"""
#: Where viser's page begins, and where it begins the program that it has unpacked.
_SCRIPTS: Final = ("<script data-p=", 'e.type="module";')

_UNSAFE: Final = {
    200: "its page is not as it should be", 101: "its page could not connect",
    403: "strangers would be let in",
}  # fmt: skip
#: Shapes of the numbers that two messages of the page consist of.
_CAMERA: Final[dict[str, tuple[int, ...]]] = {
    "wxyz": (4,), "position": (3,), "look_at": (3,), "up_direction": (3,), "fov": (), "near": (),
    "far": (), "image_height": (), "image_width": (),
}  # fmt: skip
_CLICK: Final[dict[str, tuple[int, ...]]] = {
    "ray_origin": (3,), "ray_direction": (3,), "screen_pos": (1, 2),
}  # fmt: skip
_MOST: Final = 1e9  # of a number: its square is one, too


class Guard:
    """Stands before viser on a port, of which it holds the socket.

    The page has one address: host, port, and a secret as its path.
    ``offers(control, value)``: whether a control of the page, by its number, can have a value.
    """

    def __init__(self, viser: Any, port: int, offers: Callable[[Any, Any], bool]) -> None:
        self._protocol, self._offers, self._pages = f"viser-v{viser.__version__}", offers, 0
        self._nonce = secrets.token_urlsafe(16)
        file = Path(viser.__file__).parent / "client/build/index.html"
        self._page = self._with_nonce(file.read_text("utf-8"))
        try:
            self._socket = socket.create_server((HOST, port))
        except OSError as error:
            what, where, hint = "cannot serve here", f"{HOST}:{port}", "give another --port"
            raise OutputError(what, where=where, got=error.strerror, hint=hint) from error
        self.port, self.path = self._socket.getsockname()[1], f"/{secrets.token_urlsafe(32)}"
        self.url = f"http://{HOST}:{self.port}{self.path}"
        self.hosts = f"{HOST}:{self.port}", f"localhost:{self.port}"

    def admits(self, path: str, hosts: Sequence[str]) -> bool:
        """Return whether a request asks for the page, by a name of this machine.

        A site can have a name that leads to 127.0.0.1; it stays in ``hosts``, the ``Host`` header.
        """
        given = path.encode("utf-8", "surrogateescape")
        named = len(hosts) == 1 and hosts[0] in self.hosts
        return compare_digest(given, self.path.encode()) and named

    def _with_nonce(self, page: str) -> str:
        """Return viser's page with its own scripts, and no others, allowed to run."""
        if any(page.count(one) != 1 for one in _SCRIPTS):
            raise self._unsafe("its page is another one")
        begin, run = _SCRIPTS
        ours = f'<script nonce="{self._nonce}"'
        page = page.replace(begin, f"{ours}>{_FIRST}</script>{ours} data-p=")
        return page.replace(run, f'{run}e.nonce="{self._nonce}";')

    def headers(self, host: str) -> dict[str, str]:
        """Return what tells a browser to let the page speak with this port alone."""
        policy = (
            "default-src 'none'", f"script-src 'nonce-{self._nonce}' 'wasm-unsafe-eval'",
            f"connect-src ws://{host} data:", "worker-src blob:", "img-src blob: data:",
            "style-src 'unsafe-inline'", "font-src data:", "frame-ancestors 'none'",
            "form-action 'none'", "base-uri 'none'",
        )  # fmt: skip
        return {
            "Content-Type": "text/html; charset=utf-8", "X-Content-Type-Options": "nosniff",
            "Content-Security-Policy": "; ".join(policy), "X-Frame-Options": "DENY",
            "Cross-Origin-Opener-Policy": "same-origin", "Cache-Control": "no-store",
            "Cross-Origin-Resource-Policy": "same-origin", "Referrer-Policy": "no-referrer",
        }  # fmt: skip

    def start(self, viser: Any) -> Any:
        """Return viser's server, which has nobody to share with, when strangers were refused."""
        library: Any = require("websockets.asyncio.server", extra="view")
        serve = library.serve

        def serve_here(handler: Any, *_: Any, **how: Any) -> Any:
            ours = {"sock": self._socket, "process_request": self._answer}
            enter = partial(self._enter, handler)
            return serve(enter, **{**how, **ours, "max_size": _MESSAGE_BYTES})

        with redirect_stdout(io.StringIO()):
            library.serve = serve_here
            try:
                server = viser.ViserServer(HOST, self.port, "recon", verbose=False)
            finally:
                library.serve = serve
            for gone in (viser._messages.ShareUrlRequest, viser._messages.ShareUrlDisconnect):
                server._websock_server.unregister_handler(gone)  # a tunnel from the internet
            try:
                self._check()
            except OutputError:
                stop(server)
                raise
        return server

    def _answer(self, connection: Any, request: Any) -> Any:
        """Return the page or a refusal; None = a page of ours opens its websocket."""
        asked = request.headers.get_all
        hosts, origins, upgrade = asked("Host"), asked("Origin"), asked("Upgrade")
        if not self.admits(request.path, hosts):
            return connection.respond(HTTPStatus.FORBIDDEN, _REFUSED)
        if not origins and not upgrade:
            answer = connection.respond(HTTPStatus.OK, self._page)
            del answer.headers["Content-Type"]
            answer.headers.update(self.headers(hosts[0]))
            return answer
        own = [f"http://{hosts[0]}"], [self._protocol]
        if upgrade and (origins, asked("Sec-WebSocket-Protocol")) == own:
            return None
        return connection.respond(HTTPStatus.FORBIDDEN, _REFUSED)

    async def _enter(self, handler: Callable[[Any], Any], connection: Any) -> None:
        if self._pages >= MOST_PAGES:
            await connection.close(1013, f"{MOST_PAGES} pages are open already")
            return
        self._pages += 1
        try:
            drop, send = connection.transport.abort, connection.send
            connection.recv = partial(self._take, connection.recv)
            connection.send = lambda message: send(_parts(message, drop))
            await handler(connection)
        finally:
            self._pages -= 1
            asyncio.get_running_loop().call_later(1.0, _give_back)

    async def _take(self, recv: Callable[[], Awaitable[str | bytes]]) -> str | bytes:
        """Return the next message of a page that fits."""
        while not self._fits(raw := await recv()):
            pass
        return raw

    def _fits(self, raw: str | bytes) -> bool:
        """Return whether a message is one that the page sends, with values that it can have."""
        msgspec: Any = require("msgspec", extra="view")
        try:
            match msgspec.msgpack.decode(raw):
                case {"type": "ViewerCameraMessage", **values}:
                    return _are_numbers(values, _CAMERA)
                case {
                    "type": "ScenePointerMessage", "event_type": "click", "modifier": None, **values
                }:  # fmt: skip
                    return _are_numbers(values, _CLICK)
                case {"type": "GuiUpdateMessage", "uuid": one, "updates": updates, **more}:
                    known = not more and updates.keys() == {"value"}
                    return known and self._offers(one, updates["value"])
        except (ValueError, TypeError, AttributeError, RecursionError, msgspec.MsgspecError):
            pass
        return False

    def _check(self) -> None:
        """Ask for the page as strangers would; `ReconError` where one is let in.

        What stands before viser is tied to how viser and websockets are made.
        """
        host, evil = self.hosts[0], "elsewhere.example"
        look = {"Host": host}
        join = {
            **look, "Origin": f"http://{host}", "Upgrade": "websocket", "Connection": "Upgrade",
            "Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": "A" * 22 + "==",
            "Sec-WebSocket-Protocol": self._protocol,
        }  # fmt: skip
        callers = [
            (200, self.path, look), (101, self.path, join), (403, "/", look), (403, "/", join),
            (403, f"{self.path}?websocket=ws://{evil}", look),
            (403, self.path, {**look, "Host": evil}), (403, self.path, {**join, "Host": evil}),
            (403, self.path, {**join, "Origin": f"http://{evil}"}),
            (403, self.path, {name: value for name, value in join.items() if name != "Origin"}),
        ]  # fmt: skip
        try:
            for status, path, headers in callers:
                with closing(HTTPConnection(HOST, self.port, timeout=_PATIENCE_S)) as asking:
                    asking.request("GET", path, headers=headers)
                    answer = asking.getresponse()
                lacks = self.headers(host).items() - answer.headers.items()
                if answer.status != status or (status == HTTPStatus.OK and lacks):
                    raise self._unsafe(_UNSAFE[status])
        except (OSError, HTTPException) as error:
            raise self._unsafe("it does not answer") from error

    def _unsafe(self, why: str) -> OutputError:
        hint = "install the versions of constraints.txt"
        return OutputError(f"nothing is served, as {why}", got=self._protocol, hint=hint)


def stop(server: Any) -> None:
    """Stop viser's server without a word, which it has for the terminal when its thread ends."""
    with redirect_stdout(io.StringIO()):
        server.stop()
        server._websock_server._server_thread.join(_PATIENCE_S)


def _are_numbers(values: dict[object, object], shapes: dict[str, tuple[int, ...]]) -> bool:
    """Return whether values are numbers of these shapes, none of them NaN."""
    arrays = {name: np.asarray(value) for name, value in values.items()}
    return {name: one.shape for name, one in arrays.items()} == shapes and all(
        one.dtype.kind in "if" and (np.abs(one, dtype=np.float64) <= _MOST).all()
        for one in arrays.values()
    )


def _give_back() -> None:
    """Give back what was queued for a page that is gone, which its tasks hold in circles."""
    gc.collect()
    return_free_memory()


async def _parts(message: bytes, drop: Callable[[], None]) -> AsyncIterator[bytes]:
    """Yield parts of a message, each when a page took the one before, or drop the page."""
    for start in range(0, len(message), _PART_BYTES):
        patience = asyncio.get_running_loop().call_later(_PATIENCE_S, drop)
        try:
            yield message[start : start + _PART_BYTES]
        finally:
            patience.cancel()

"""Who is let into a page that is served on this machine, and what is taken from it.

The pages of any web site, of any other local port, and everybody who has an account here can
connect to a port of 127.0.0.1. So a page has one address, whose path is a secret.
"""

from __future__ import annotations

import asyncio
import secrets
import socket
from base64 import b64encode
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from hmac import compare_digest
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from recon.core.errors import OutputError, require
from recon.view.scene import HOST

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

_Number = Annotated[float, Field(ge=-1e9, le=1e9)]
_Three = Annotated[list[_Number], Field(min_length=3, max_length=3)]
_Value = str | bool | int


class _Message(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)


class _Camera(_Message):
    type: Literal["ViewerCameraMessage"]
    wxyz: Annotated[list[_Number], Field(min_length=4, max_length=4)]
    position: _Three
    fov: _Number
    near: _Number
    far: _Number
    image_height: Annotated[int, Field(ge=0, le=100_000)]
    image_width: Annotated[int, Field(ge=0, le=100_000)]
    look_at: _Three
    up_direction: _Three


class _Click(_Message):
    type: Literal["ScenePointerMessage"]
    event_type: Literal["click"]
    ray_origin: _Three
    ray_direction: _Three
    screen_pos: Annotated[
        list[Annotated[list[_Number], Field(min_length=2, max_length=2)]],
        Field(min_length=1, max_length=1),
    ]
    modifier: None


class _Updates(_Message):
    value: _Value


class _Choice(_Message):
    type: Literal["GuiUpdateMessage"]
    uuid: str
    updates: _Updates


_MESSAGES: Final[TypeAdapter[_Camera | _Click | _Choice]] = TypeAdapter(
    Annotated[_Camera | _Click | _Choice, Field(discriminator="type")]
)


class Gate:
    """The one address of a page of this machine: host, port, and a secret as its path."""

    def __init__(self, port: int) -> None:
        self.port, self.path = port, f"/{secrets.token_urlsafe(32)}"
        self.url = f"http://{HOST}:{port}{self.path}"
        self.hosts = f"{HOST}:{port}", f"localhost:{port}"

    def admits(self, path: str, hosts: Sequence[str]) -> bool:
        """Return whether a request asks for the page, by a name of this machine.

        A site can have a name that leads to 127.0.0.1; it stays in ``hosts``, the ``Host`` header.
        """
        given = path.encode("utf-8", "surrogateescape")
        named = len(hosts) == 1 and hosts[0] in self.hosts
        return compare_digest(given, self.path.encode()) and named


class Guard(Gate):
    """Stands before viser on a port, of which it holds the socket.

    ``offers(control, value)``: whether a control of the page, by its number, can have a value.
    """

    def __init__(self, viser: Any, port: int, offers: Callable[[str, _Value], bool]) -> None:
        self._protocol, self._offers, self._pages = f"viser-v{viser.__version__}", offers, 0
        self._nonce = secrets.token_urlsafe(16)
        file = Path(viser.__file__).parent / "client/build/index.html"
        self._page = self._with_nonce(file.read_text("utf-8"))
        try:
            self._socket = socket.create_server((HOST, port))
        except OSError as error:
            what, where, hint = "cannot serve here", f"{HOST}:{port}", "give another --port"
            raise OutputError(what, where=where, got=error.strerror, hint=hint) from error
        super().__init__(self._socket.getsockname()[1])

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
            "Content-Type": "text/html; charset=utf-8",
            "Content-Security-Policy": "; ".join(policy),
            "Cache-Control": "no-store",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",  # the address is the secret
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
        }

    @contextmanager
    def before(self) -> Iterator[None]:
        """Stand before the server that viser starts meanwhile."""
        library: Any = require("websockets.asyncio.server", extra="view")
        serve = library.serve

        def serve_here(handler: Any, *_: Any, **how: Any) -> Any:
            ours = {"sock": self._socket, "process_request": self._answer}
            enter = partial(self._enter, handler)
            return serve(enter, **{**how, **ours, "max_size": _MESSAGE_BYTES})

        library.serve = serve_here
        try:
            yield
        finally:
            library.serve = serve

    def _answer(self, connection: Any, request: Any) -> Any:
        """Return the page or a refusal; None = a page of ours opens its websocket."""
        asked = request.headers.get_all
        hosts, origins, upgrade = asked("Host"), asked("Origin"), asked("Upgrade")
        if not self.admits(request.path, hosts) or bool(origins) != bool(upgrade):
            return connection.respond(HTTPStatus.FORBIDDEN, _REFUSED)
        if not upgrade:
            answer = connection.respond(HTTPStatus.OK, self._page)
            del answer.headers["Content-Type"]
            answer.headers.update(self.headers(hosts[0]))
            return answer
        own = (origins, asked("Sec-WebSocket-Protocol"))
        if own != ([f"http://{hosts[0]}"], [self._protocol]):
            return connection.respond(HTTPStatus.FORBIDDEN, _REFUSED)
        return None

    async def _enter(self, handler: Callable[[Any], Any], connection: Any) -> None:
        if self._pages >= MOST_PAGES:
            await connection.close(1013, f"{MOST_PAGES} pages are open already")
            return
        self._pages += 1
        try:
            await handler(_Connection(connection, self._fits))
        finally:
            self._pages -= 1

    def _fits(self, raw: str | bytes) -> bool:
        """Return whether a message is one that the page sends, with values that it can have."""
        msgspec: Any = require("msgspec", extra="view")
        try:
            message = _MESSAGES.validate_python(msgspec.msgpack.decode(raw))
        except (ValueError, TypeError, RecursionError, msgspec.MsgspecError):
            return False
        if isinstance(message, _Choice):
            return self._offers(message.uuid, message.updates.value)
        return True

    def check(self) -> None:
        """Ask for the page as strangers would; `ReconError` where one is let in.

        What stands before viser is tied to how viser and websockets are made.
        """
        host, evil = self.hosts[0], "elsewhere.example"
        look, key = {"Host": host}, b64encode(bytes(16)).decode()
        join = {
            **look, "Origin": f"http://{host}", "Upgrade": "websocket", "Connection": "Upgrade",
            "Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": key,
            "Sec-WebSocket-Protocol": self._protocol,
        }  # fmt: skip
        strangers = [
            ("/", look), ("/", join), (f"{self.path}?websocket=ws://{evil}", look),
            (self.path, {**look, "Host": evil}), (self.path, {**join, "Host": evil}),
            (self.path, {**join, "Origin": f"http://{evil}"}),
            (self.path, {name: value for name, value in join.items() if name != "Origin"}),
        ]  # fmt: skip
        page, wanted = self._ask(self.path, look), self.headers(host).items()
        if page[0] != HTTPStatus.OK or not wanted <= page[1].items():
            raise self._unsafe("its page is not served as it should be")
        if self._ask(self.path, join)[0] != HTTPStatus.SWITCHING_PROTOCOLS:
            raise self._unsafe("its page could not connect")
        for path, headers in strangers:
            if self._ask(path, headers)[0] != HTTPStatus.FORBIDDEN:
                raise self._unsafe("strangers would be let in")

    def _ask(self, path: str, headers: dict[str, str]) -> tuple[int, dict[str, str]]:
        try:
            with closing(HTTPConnection(HOST, self.port, timeout=_PATIENCE_S)) as asking:
                asking.request("GET", path, headers=headers)
                answer = asking.getresponse()
                return answer.status, dict(answer.getheaders())
        except (OSError, HTTPException) as error:
            raise self._unsafe("it does not answer") from error

    def _unsafe(self, why: str) -> OutputError:
        hint = "install the versions of constraints.txt"
        return OutputError(f"nothing is served, as {why}", got=self._protocol, hint=hint)


class _Connection:
    """The connection of a page as viser has it: what comes is checked, what goes is bounded."""

    def __init__(self, connection: Any, fits: Callable[[str | bytes], bool]) -> None:
        self._connection, self._fits = connection, fits

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self) -> str | bytes:
        """Return the next message that fits."""
        while True:
            raw: str | bytes = await self._connection.recv()
            if self._fits(raw):
                return raw

    async def send(self, message: bytes) -> None:
        """Send a message in parts, each when the one before was taken."""
        await self._connection.send(self._parts(message))

    async def _parts(self, message: bytes) -> AsyncIterator[bytes]:
        loop, drop = asyncio.get_running_loop(), self._connection.transport.abort
        for start in range(0, len(message), _PART_BYTES):
            patience = loop.call_later(_PATIENCE_S, drop)
            try:
                yield message[start : start + _PART_BYTES]
            finally:
                patience.cancel()

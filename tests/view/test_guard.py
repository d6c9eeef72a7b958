"""Who is let in to the page of a viewer, and what its messages can do."""

import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from recon.core.errors import OutputError
from recon.view import guard
from recon.view.guard import Guard
from recon.view.server import Viewer
from tests.view.conftest import Served, Views, small_scene, until

msgspec = pytest.importorskip("msgspec", reason="the extra view is not installed")
client = pytest.importorskip("websockets.sync.client")
exceptions = pytest.importorskip("websockets.exceptions")


def ask(served: Served, path: str, method: str = "GET", **headers: str) -> tuple[int, bytes, dict]:
    with closing(HTTPConnection("127.0.0.1", served.port, timeout=30)) as asking:
        asking.request(method, path, headers={"Host": served.host, **headers})
        answer = asking.getresponse()
        return answer.status, answer.read(), dict(answer.getheaders())


@contextmanager
def joined(served: Served, protocol: str, **how: object) -> Iterator[object]:
    """A websocket as the page opens it."""
    how = {"origin": f"http://{served.host}", "subprotocols": [protocol], "max_size": None} | how
    with client.connect(served.url.replace("http", "ws", 1), **how) as page:
        yield page


def test_the_page_may_speak_with_its_own_port_alone(standing):
    status, page, headers = ask(standing, standing.path)
    assert (status, b"<html" in page) == (200, True)
    parts = headers["Content-Security-Policy"].split("; ")
    policy = {name: [*values] for name, *values in (part.split() for part in parts)}
    assert policy["connect-src"] == [f"ws://{standing.host}", "data:"]
    for closed in ("default-src", "frame-ancestors", "form-action", "base-uri"):
        assert policy[closed] == ["'none'"]
    (nonce, wasm) = policy["script-src"]
    assert wasm == "'wasm-unsafe-eval'"
    assert page.count(b"<script") == page.count(b'<script nonce="' + nonce[7:-1].encode())
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["X-Frame-Options"] == "DENY"
    assert headers["Referrer-Policy"] == "no-referrer"
    assert headers["Cache-Control"] == "no-store"


def test_other_machines_cannot_connect(standing):
    with socket.create_connection(("127.0.0.1", standing.port)) as own:
        assert own.getpeername()[0] == "127.0.0.1"
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", standing.port), timeout=5)


def test_by_its_other_name_a_page_speaks_with_that_name(standing):
    _, _, headers = ask(standing, standing.path, Host=f"localhost:{standing.port}")
    assert f"connect-src ws://localhost:{standing.port} " in headers["Content-Security-Policy"]


@pytest.mark.parametrize(
    "path",
    [
        "/", "/index.html", "/%2e%2e/index.html", "/..%5cindex.html", "{path}/",
        "{path}/index.html", "{path}x", "{less}", "//{path}", "/.{path}", "{path}?", "{path}?websocket=ws://elsewhere",
        "{path}?websocket=ws://{host}{path}", "{path}?playbackPath=http://elsewhere/map.viser",
        "{path}?darkMode", "{path}%3Fwebsocket=ws://elsewhere", "{upper}", "http://{host}{path}",
        "{path}#", "{path};", "*",
    ],
)  # fmt: skip
def test_no_other_address_is_answered(standing, path):
    less, upper = standing.path[:-1], standing.path.swapcase()
    path = path.format(path=standing.path, less=less, upper=upper, host=standing.host)
    status, body, headers = ask(standing, path)
    assert (status, b"<html" in body) == (403, False)
    assert "Location" not in headers


@pytest.mark.parametrize("method", ["HEAD", "POST", "PUT", "OPTIONS", "TRACE"])
def test_a_page_is_only_got(standing, method):
    with socket.create_connection(("127.0.0.1", standing.port)) as asking:
        asking.settimeout(30)
        asking.sendall(
            f"{method} {standing.path} HTTP/1.1\r\nHost: {standing.host}\r\n\r\n".encode()
        )
        assert asking.recv(1 << 16).split()[1:2] not in ([b"200"], [b"101"])


@pytest.mark.parametrize(
    "name",
    [
        "elsewhere.example", "elsewhere.example:{port}", "127.0.0.1", "127.0.0.1:1", "localhost",
        "127.0.0.2:{port}", "[::1]:{port}", "localhost.:{port}", "0.0.0.0:{port}",
        "2130706433:{port}", "127.0.0.1:{port}@elsewhere.example",
        "127.0.0.1:{port}.elsewhere.example", "",
    ],
)  # fmt: skip
def test_a_site_whose_name_leads_here_is_refused(standing, protocol, name):
    name = name.format(port=standing.port)
    assert ask(standing, standing.path, Host=name)[0] == 403
    origin = {"origin": f"http://{name}", "additional_headers": {"Host": name}}
    with pytest.raises(exceptions.InvalidHandshake), joined(standing, protocol, **origin):
        pass


def test_two_hosts_are_none(standing):
    request = f"GET {standing.path} HTTP/1.1\r\n" + f"Host: {standing.host}\r\n" * 2 + "\r\n"
    with socket.create_connection(("127.0.0.1", standing.port)) as asking:
        asking.settimeout(30)
        asking.sendall(request.encode())
        assert asking.recv(1 << 16).split()[1] == b"403"


@pytest.mark.parametrize(
    "origin",
    [
        None, "null", "https://elsewhere.example", "http://localhost:{port}", "http://127.0.0.1",
        "http://127.0.0.1:9999", "http://localhost:9999", "https://127.0.0.1:{port}",
        "http://127.0.0.1:{port}.elsewhere.example", "http://127.0.0.1:{port}/", "file://",
    ],
)  # fmt: skip
def test_a_page_of_another_site_is_refused_even_with_the_secret(standing, protocol, origin):
    origin = origin and origin.format(port=standing.port)
    refused = pytest.raises(exceptions.InvalidStatus, match="403")
    with refused, joined(standing, protocol, origin=origin):
        pass
    if origin is not None:
        assert ask(standing, standing.path, Origin=origin)[0] == 403


def test_without_the_secret_nobody_is_let_in(standing, protocol):
    for path in ("", "/", "/" + "A" * 43, standing.path[:-1], f"{standing.path}?a=b"):
        place = f"ws://{standing.host}{path}"
        with pytest.raises(exceptions.InvalidStatus, match="403"):
            client.connect(place, origin=f"http://{standing.host}", subprotocols=[protocol])
    with joined(standing, protocol) as page:
        assert len(page.recv(timeout=30)) > 0


def test_secrets_are_long_and_never_the_same():
    viser = pytest.importorskip("viser")
    paths = {Guard(viser, 0, lambda *_: True).path for _ in range(20)}
    assert len(paths) == 20
    assert {len(path) for path in paths} == {44}  # 256 bits


def test_another_version_of_the_page_is_refused_without_a_word(standing, capfd):
    for other in ("viser-v0.0.0", "else"):
        with pytest.raises(exceptions.InvalidStatus, match="403"), joined(standing, other):
            pass
    assert capfd.readouterr() == ("", "")


CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [1, 2.5, 3],
    "fov": 1.0, "near": 0.1, "far": 1e3, "image_height": 900, "image_width": 1600,
    "look_at": [0.0, 0.0, 0.0], "up_direction": [0.0, 0.0, 1.0],
}  # fmt: skip
CLICK = {
    "type": "ScenePointerMessage", "event_type": "click", "ray_origin": [0.5, 0.5, -3.0],
    "ray_direction": [0.0, 0.0, 1.0], "screen_pos": [[0.5, 0.5]], "modifier": None,
}  # fmt: skip


def choice(served: Served, label: str, value: object) -> dict:
    """A message that sets a control of the page."""
    controls = served.viewer._controls
    (uuid,) = (uuid for uuid, control in controls.items() if control.label == label)
    return {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}


def test_what_the_page_sends_is_done(served, protocol):
    viewer = served.viewer
    with joined(served, protocol) as page:
        page.send(msgspec.msgpack.encode(CAMERA))
        assert until(lambda: viewer._eye_m.tolist() == [1.0, 2.5, 3.0])
        page.send(msgspec.msgpack.encode(choice(served, "Colours", "height")))
        assert until(lambda: "blue to red" in viewer._legend.content)
        page.send(msgspec.msgpack.encode(choice(served, "Show cloud", value=False)))
        assert until(lambda: not viewer._layers[0][1].visible)
        page.send(msgspec.msgpack.encode(choice(served, "Keyframe", 1)))
        assert until(lambda: "keyframe 1" in viewer._said.content)
        page.send(msgspec.msgpack.encode(CLICK))
        assert until(lambda: "keyframe 0" in viewer._said.content)


def test_tools_of_the_page_measure_and_choose_points(served, protocol):
    viewer = served.viewer
    whole = len(viewer._parts[0].cloud)

    def shown() -> int:
        return sum(len(part.cloud) for part, _ in viewer._shown.values())

    with joined(served, protocol) as page:
        page.send(msgspec.msgpack.encode(CAMERA))
        assert until(lambda: viewer.looked_at)
        for label, value in (("Point size", 2.5), ("A click shows", "distance")):
            page.send(msgspec.msgpack.encode(choice(served, label, value)))
        assert until(lambda: viewer._size.value == 2.5)
        assert until(lambda: node(viewer, "/cloud/0_0").point_size == pytest.approx(0.25))
        for count, (x, y, _) in enumerate(viewer._parts[0].cloud.xyz[:2].tolist(), 1):
            page.send(msgspec.msgpack.encode(CLICK | {"ray_origin": [x, y, -3.0]}))
            assert until(lambda count=count: len(viewer._places) == count)
            assert np.hypot(*(viewer._places[-1].xyz[0, :2] - [x, y])) < 0.06
        assert until(lambda: "distance: 0." in viewer._measured.content)
        assert node(viewer, "/measured/lines") is not None
        page.send(msgspec.msgpack.encode(choice(served, "Clear what is measured", value=True)))
        assert until(lambda: not viewer._measured.content)
        assert until(lambda: node(viewer, "/measured/lines") is None)
        page.send(msgspec.msgpack.encode(choice(served, "Forward, x (m)", [0, 0.25])))
        assert until(lambda: 0.2 * whole < shown() < 0.3 * whole)
        page.send(msgspec.msgpack.encode(choice(served, "Left, y (m)", [0.0, 0.0])))
        assert until(lambda: shown() == 0)
        assert node(viewer, "/cloud/0_0") is None
        page.send(msgspec.msgpack.encode(choice(served, "Left, y (m)", [0, 1])))
        page.send(msgspec.msgpack.encode(choice(served, "Forward, x (m)", [0, 1])))
        assert until(lambda: shown() == whole)


class Clicked(Views):
    """Keyframes with an image, in which a control point can be clicked if the ray goes up."""

    points, marked = {"p1": np.array([0.5, 0.5, 0.5])}, ()

    def look(self, number: int) -> tuple[list[str], np.ndarray]:
        return [f"keyframe {number}"], np.zeros((30, 20, 3), np.uint8)

    def mark(self, name: str, number: int, ray: np.ndarray, depth_m: float) -> list[str]:
        self.marked = (name, number, ray.tolist())
        return ["p1, map minus survey:"] if ray[1, 2] > 0 else []


def test_a_click_at_the_image_of_a_keyframe_is_one_at_the_chosen_control_point(served, protocol):
    viewer = served.viewer
    assert not viewer._point.visible
    viewer.show(Path("run"), replace(small_scene(), keyframes=(views := Clicked())))
    assert viewer._point.visible
    with joined(served, protocol) as page:
        nowhere = CAMERA | {"position": [0] * 3, "up_direction": [0] * 3}
        for message in (CAMERA, nowhere, choice(served, "Control point", "p2"), CLICK):
            page.send(msgspec.msgpack.encode(message))
        assert until(lambda: "keyframe 0" in viewer._said.content)
        assert (views.marked, node(viewer, "/control/image")) == ((), None)
        page.send(msgspec.msgpack.encode(choice(served, "Control point", "p1")))
        assert until(lambda: node(viewer, "/control/image"))
        assert "The place at 0.5, 0.5, 0.5 m was seen by 2 keyframes: 0, 1" in viewer._said.content
        assert "Click p1 in the image" in viewer._residual.content
        page.send(msgspec.msgpack.encode(CLICK))
        assert until(lambda: "p1, map minus survey:" in viewer._residual.content)
        assert views.marked == ("p1", 0, [CLICK["ray_origin"], CLICK["ray_direction"]])
        page.send(msgspec.msgpack.encode(choice(served, "Control point", "none")))
        assert until(lambda: node(viewer, "/control/image") is None)
        assert not viewer._residual.content


def node(viewer: Viewer, name: str) -> object:
    return viewer._server.scene.get_handle_by_name(name)


NAN, FAR = float("nan"), 1e300


def hostile(served: Served) -> list[dict]:
    cameras = [
        {name: value} for name in ("position", "look_at", "up_direction")
        for value in ([1.0, 2.0], [1.0] * 4, [NAN, 0.0, 0.0], [FAR] * 3, None, "abc", [[1.0]] * 3)
    ]  # fmt: skip
    cameras += [
        {"wxyz": [1.0] * 3},
        {"wxyz": [NAN] * 4},
        {"fov": NAN},
        {"fov": True},
        {"near": "0"},
        {"more": 1},
    ]
    cameras += [{"image_height": -(1 << 63)}, {"image_width": (1 << 64) - 1}, {"far": {}}]
    clicks = [
        {name: value} for name in ("ray_origin", "ray_direction")
        for value in ([1.0] * 4, [1.0] * 2, [NAN] * 3, [FAR] * 3, None, [], ["a"] * 3)
    ]  # fmt: skip
    clicks += [{"screen_pos": []}, {"screen_pos": [[1.0]]}, {"event_type": "rect-select"}]
    clicks += [{"event_type": 3}, {"modifier": [1]}, {"modifier": "alt"}]
    values = [
        choice(served, label, value)
        for label in ("Colours", "Show cloud", "Keyframe")
        for value in ("nothing", "age", 2, -1, 1 << 62, 0.5, NAN, None, [], {}, ["image"], b"a")
    ]
    values += [
        choice(served, label, value)
        for label in (
            "A click shows",
            "Clear what is measured",
            "Point size",
            "Forward, x (m)",
            "Control point",
        )
        for value in ("nothing", 9, -1, 1 << 62, 9.5, NAN, None, [], {}, ["area"], b"a", [1.0])
    ]
    values += [
        choice(served, "Forward, x (m)", value)
        for value in ([NAN, 0.5], [0.1, NAN], [0.5, 0.1], [-1.0, 0.5], [0.5, FAR], [0.1] * 3,
                      [True, 1.0], ["0", "1"], [None, 1.0], {"0": 1}, "01", [[0.1], [0.5]])
    ]  # fmt: skip
    # Of what nothing is known yet, nothing can be chosen.
    values += [choice(served, "Drives", [0.0, 0.5]), choice(served, "Drives", [0.0, 1.0])]
    uuid = choice(served, "Colours", "")["uuid"]
    updates = [{"options": []}, {"value": "height", "visible": False}, {}, {"_impl": 1}, [], None]
    return [
        *({**CAMERA, **change} for change in cameras), *({**CLICK, **change} for change in clicks),
        *values, *({"type": "GuiUpdateMessage", "uuid": uuid, "updates": one} for one in updates),
        {**choice(served, "Colours", "height"), "more": 1},
        {"type": "GuiUpdateMessage", "uuid": "none", "updates": {"value": "height"}},
        {"type": "GuiUpdateMessage", "uuid": [uuid], "updates": {"value": "height"}},
        {"type": "RunJavascriptMessage", "source": "1"}, {"type": "Message"}, {"type": None}, {},
        {"type": "ShareUrlRequest"}, {"type": "ShareUrlDisconnect"}, {"type": ["GuiUpdateMessage"]},
        {"type": "FileTransferStartUpload", "source_component_uuid": uuid, "transfer_uuid": "a",
         "filename": "../a", "mime_type": "", "part_count": 1 << 40, "size_bytes": 1 << 60},
        {"type": "FileTransferPart", "source_component_uuid": uuid, "transfer_uuid": "a",
         "part_index": 0, "content": b"a" * 1000},
        {"type": "GuiSetPanelLabelMessage", "label": "a"}, {"type": "CommandTriggerMessage"},
        {"type": "ThemeConfigurationMessage"}, {"type": "RemoveSceneNodeMessage", "name": "/cloud"},
        {"type": "SceneNodeClickMessage", "name": "/cloud", "instance_index": None},
        {"type": "LocalStorageGetItemResponseMessage"}, {"type": "GetRenderResponseMessage"},
    ]  # fmt: skip


RAW = [
    b"", b"\xc1", b"\xff" * 100, b"\x91" * 5000, b"\x81" * 5000, b"\xdd\xff\xff\xff\xff",
    b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xd9\x02\xff\xff", b"\xc7\x00\xff",
    b"\x81\x90\x01", b"\x81\xc0\x01", b"\xa4type", "text", b"\xd6\xff\xff\xff\xff\xff",
    msgspec.msgpack.encode([CAMERA]), msgspec.msgpack.encode("a"), msgspec.msgpack.encode(1),
]  # fmt: skip


def test_no_message_changes_what_it_may_not_or_ends_the_viewer(served, protocol, capfd):
    viewer = served.viewer
    with joined(served, protocol) as page:
        page.send(msgspec.msgpack.encode(CAMERA))
        assert until(lambda: viewer.looked_at)
        for raw in (*RAW, *map(msgspec.msgpack.encode, hostile(served))):
            page.send(raw)
        # One that is answered: all before it were taken by then.
        page.send(msgspec.msgpack.encode(choice(served, "Colours", "height")))
        assert until(lambda: "blue to red" in viewer._legend.content)
        assert served.ended is None
        assert viewer._by.value == "height"
        assert viewer._slider.value == 0
        assert (viewer._tool.value, viewer._size.value) == ("who saw it", 1.0)
        assert {one.value for one in viewer._limits.values()} == {(0.0, 1.0)}
        # As at first.
        assert [box.value for box, _ in viewer._layers] == [True, False, False, True, True]
        assert viewer._eye_m.tolist() == [1.0, 2.5, 3.0]
        assert "keyframe" not in viewer._said.content
    assert capfd.readouterr() == ("", "")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    st.one_of(
        st.binary(max_size=200),
        st.recursive(
            st.none() | st.booleans() | st.integers(-(1 << 63), (1 << 63) - 1) | st.floats()
            | st.text(max_size=5) | st.binary(max_size=5),
            lambda one: st.lists(one, max_size=4) | st.dictionaries(st.text(max_size=5), one),
        ).map(msgspec.msgpack.encode),
        st.tuples(st.sampled_from([CAMERA, CLICK]), st.sampled_from([*CAMERA, *CLICK]), st.floats())
        .map(lambda some: msgspec.msgpack.encode(some[0] | {some[1]: some[2]})),
    )
)  # fmt: skip
def test_what_is_taken_is_a_message_of_the_page(raw):
    def refuse(*_: object) -> bool:
        return False

    bare = object.__new__(Guard)
    bare._offers = refuse
    if bare._fits(raw):
        taken = msgspec.msgpack.decode(raw)
        before = CAMERA if taken["type"] == CAMERA["type"] else CLICK
        assert taken.keys() == before.keys()
        for name, value in before.items():
            assert np.shape(taken[name]) == np.shape(value)
            if isinstance(value, float):
                assert np.isfinite(taken[name])


def test_a_message_larger_than_any_of_the_page_ends_its_connection_alone(served, protocol, capfd):
    with joined(served, protocol) as page, joined(served, protocol) as other:
        page.send(b"\xdd" + bytes(1 << 20))
        with suppress(exceptions.ConnectionClosed):
            while page.recv(timeout=30):
                pass
        assert page.close_code == 1009
        other.send(msgspec.msgpack.encode(CAMERA))
        assert until(lambda: served.viewer.looked_at)
    assert capfd.readouterr() == ("", "")


def test_a_colouring_that_is_no_longer_known_is_not_drawn(served):
    viewer = served.viewer
    viewer._by._impl.value = "age"  # chosen while what is shown was about to change
    viewer._note(drawn=True)
    assert until(lambda: not viewer._wanted)
    viewer._note(keyframe=7)
    assert until(lambda: "keyframe 1" in viewer._said.content)


def test_asking_for_a_tunnel_reaches_nobody(served, protocol, monkeypatch):
    import viser

    handled = served.viewer._server._websock_server._incoming_handlers
    assert viser._messages.ShareUrlRequest not in handled
    assert viser._messages.ShareUrlDisconnect not in handled
    with socket.create_server(("127.0.0.1", 0)) as proxy:
        proxy.settimeout(1.0)
        for name in ("http_proxy", "https_proxy", "all_proxy"):
            for one in (name, name.upper()):
                monkeypatch.setenv(one, f"http://127.0.0.1:{proxy.getsockname()[1]}")
        for name in ("no_proxy", "NO_PROXY"):
            monkeypatch.delenv(name, raising=False)
        with joined(served, protocol, proxy=None) as page:
            page.send(msgspec.msgpack.encode(CAMERA))
            assert until(lambda: served.viewer.looked_at)
            for kind in ("ShareUrlRequest", "ShareUrlDisconnect"):
                page.send(msgspec.msgpack.encode({"type": kind}))
            page.send(msgspec.msgpack.encode(choice(served, "Colours", "height")))
            assert until(lambda: "blue to red" in served.viewer._legend.content)
        with pytest.raises(TimeoutError):
            proxy.accept()


def stalled(served: Served, protocol: str) -> socket.socket:
    """A page that asks for the scene and takes nothing."""
    one = socket.socket()
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    one.connect(("127.0.0.1", served.port))
    one.sendall(
        f"GET {served.path} HTTP/1.1\r\nHost: {served.host}\r\nOrigin: http://{served.host}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
        f"Sec-WebSocket-Protocol: {protocol}\r\n\r\n".encode()
    )
    return one


def queued_bytes(served: Served) -> list[int]:
    connections = served.viewer._server._websock_server._live_connections.values()
    return [one.transport.get_write_buffer_size() for one in connections]


def test_pages_that_take_nothing_are_few_wait_with_little_and_are_dropped(
    served, protocol, monkeypatch, capfd
):
    monkeypatch.setattr(guard, "_PATIENCE_S", 3.0)
    served.viewer.looked_at = True
    served.viewer.show(Path("run"), small_scene(400_000))  # 6 MB
    with ExitStack() as waiting:
        for _ in range(3 * guard.MOST_PAGES):
            waiting.enter_context(stalled(served, protocol))
        assert until(lambda: any(queued_bytes(served)))
        assert served.pages() <= guard.MOST_PAGES
        assert max(queued_bytes(served), default=0) < 1_000_000
        assert until(lambda: served.pages() == 0)
        with joined(served, protocol) as page:  # one that takes what it is given
            received = 0
            while received < 15 * 100_000:
                received += len(page.recv(timeout=60))
    assert capfd.readouterr() == ("", "")


def test_as_many_pages_as_are_offered_may_look(served, protocol):
    with ExitStack() as looking:
        for _ in range(guard.MOST_PAGES):
            one = looking.enter_context(joined(served, protocol))
            assert len(one.recv(timeout=30)) > 0
        with joined(served, protocol) as more, pytest.raises(exceptions.ConnectionClosed):
            more.recv(timeout=30)
        assert (more.close_code, more.close_reason) == (1013, "8 pages are open already")
    assert until(lambda: served.pages() == 0)
    with joined(served, protocol) as again:
        assert len(again.recv(timeout=30)) > 0


def let_in(kept: object, connection: object, request: object) -> object:
    """An answer that looks at nothing of a request."""
    request.path = kept.path
    for name, value in (("Host", kept.hosts[0]), ("Origin", f"http://{kept.hosts[0]}")):
        if name == "Host" or "Upgrade" in request.headers:
            del request.headers[name]
            request.headers[name] = value
    return ANSWER(kept, connection, request)


ANSWER = Guard._answer
BROKEN = {
    "strangers would be let in": ("_answer", let_in),
    "its page is not as it should be": (
        "_answer",
        lambda self, connection, _: connection.respond(200, ""),
    ),
    "its page could not connect": (
        "_answer",
        lambda self, connection, request: (
            connection.respond(403, "")
            if "Upgrade" in request.headers
            else ANSWER(self, connection, request)
        ),
    ),
}


@pytest.mark.parametrize("why", BROKEN)
def test_nothing_is_served_where_the_library_lets_strangers_in(why, monkeypatch, capfd):
    pytest.importorskip("viser", reason="the extra view is not installed")
    monkeypatch.setattr(Guard, *BROKEN[why])
    with pytest.raises(OutputError, match=f"nothing is served, as {why}.*constraints.txt"):
        Viewer(0)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("part", ["host", "origin", "secret", "query"])
def test_each_check_is_asked_for_at_the_start(part, monkeypatch):
    pytest.importorskip("viser", reason="the extra view is not installed")

    def lax(kept: Guard, connection: object, request: object) -> object:
        host, path = kept.hosts[0], request.path
        if part == "host":
            del request.headers["Host"]
            request.headers["Host"] = host
        if part == "origin" and "Upgrade" in request.headers:
            del request.headers["Origin"]
            request.headers["Origin"] = f"http://{host}"
        if part == "secret" and path == "/":
            request.path = kept.path
        if part == "query":
            request.path = path.partition("?")[0]
        return ANSWER(kept, connection, request)

    monkeypatch.setattr(Guard, "_answer", lax)
    with pytest.raises(OutputError, match="strangers would be let in"):
        Viewer(0)


def test_nothing_is_served_where_viser_no_longer_asks_the_guard(monkeypatch):
    pytest.importorskip("viser", reason="the extra view is not installed")
    monkeypatch.setattr(guard, "_PATIENCE_S", 1.0)
    monkeypatch.setattr(guard, "require", lambda *_, **__: SimpleNamespace(serve=None))
    with pytest.raises(OutputError, match="nothing is served, as it does not answer"):
        Viewer(0)


def test_nothing_is_served_of_another_page(monkeypatch, tmp_path):
    viser = pytest.importorskip("viser", reason="the extra view is not installed")
    (tmp_path / "client/build").mkdir(parents=True)
    (tmp_path / "client/build/index.html").write_text("<script>1</script>")
    monkeypatch.setattr(viser, "__file__", str(tmp_path / "__init__.py"))
    with pytest.raises(OutputError, match="its page is another one"):
        Viewer(0)


def test_names_of_others_are_text(served):
    name = '<img src=x onerror="alert(1)"> ![](http://elsewhere.example/a) {alert(1)}'
    scene = small_scene()
    object.__setattr__(scene, "lines", [name])
    served.viewer.show(Path("run"), scene)
    shown = served.viewer._text.content
    assert "<img" not in shown
    assert "&lt;img src=x onerror=&quot;alert(1)&quot;&gt;" in shown

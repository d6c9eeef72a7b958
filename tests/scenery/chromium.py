"""A page in headless Chromium, as its developer tools see it; with a package that viser brings."""

import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

_NAMES = ("chromium", "chromium-browser", "google-chrome")
PROGRAM = next(filter(None, map(shutil.which, _NAMES)), None)
_QUIET = (
    "--headless=new", "--no-sandbox", "--no-first-run", "--disable-background-networking",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--remote-debugging-port=0",
)  # fmt: skip
_PATIENCE_S = 120.0


class Page:
    """What happened in a page so far: ``errors`` of its console, ``urls`` it asked for, bytes."""

    def __init__(self, tools: Any) -> None:
        self._tools = tools
        self.errors: list[str] = []
        self.urls: list[str] = []
        self.received = 0
        # Its workers, too, whose connections are seen from their beginning.
        way = {"autoAttach": True, "waitForDebuggerOnStart": True, "flatten": True}
        self._send("Target.setAutoAttach", way)
        self._follow({})

    def open(self, url: str) -> None:
        self._send("Page.navigate", {"url": url})

    def _send(self, method: str, about: dict[str, Any], **to: Any) -> None:
        self._tools.send(json.dumps({"id": 1, "method": method, "params": about} | to))

    def emulate(self, what: str, **how: Any) -> None:
        """Give the page another screen, or paper: a command of the domain ``Emulation``."""
        self._send(f"Emulation.{what}", how)

    def run(self, script: str) -> Any:
        """Return the value of an expression, of a promise that which it comes to."""
        how = {"awaitPromise": True, "returnByValue": True, "allowUnsafeEvalBlockedByCSP": False}
        self._send("Runtime.evaluate", {"expression": script, **how}, id=2)
        while (answer := json.loads(self._tools.recv(timeout=_PATIENCE_S))).get("id") != 2:
            self._note(answer)
        return answer["result"]["result"].get("value")

    def press(self, key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            self._send("Input.dispatchKeyEvent", {"type": kind, "key": key, "code": key})

    def click(self, x_px: float, y_px: float) -> None:
        for kind, button in (("Moved", "none"), ("Pressed", "left"), ("Released", "left")):
            where = {"x": x_px, "y": y_px, "button": button, "clickCount": 1}
            self._send("Input.dispatchMouseEvent", {"type": f"mouse{kind}", **where})
            self.wait(0.5)

    def _follow(self, to: dict[str, Any]) -> None:
        for domain in ("Runtime", "Log", "Network"):
            self._send(f"{domain}.enable", {}, **to)

    def wait(self, seconds: float, least: float = float("inf")) -> None:
        """Follow the page until it has received so many bytes, or for so long."""
        end = time.monotonic() + seconds
        while self.received < least and time.monotonic() < end:
            with suppress(TimeoutError):
                self._note(json.loads(self._tools.recv(timeout=0.2)))

    def _note(self, event: dict[str, Any]) -> None:
        about = event.get("params", {})
        match event.get("method"):
            case "Target.attachedToTarget":
                worker = {"sessionId": about["sessionId"]}
                self._follow(worker)
                self._send("Runtime.runIfWaitingForDebugger", {}, **worker)
            case "Runtime.exceptionThrown":
                self.errors.append(str(about["exceptionDetails"]))
            case "Runtime.consoleAPICalled" if about["type"] in ("error", "assert"):
                self.errors.append(str(about["args"]))
            case "Log.entryAdded" if about["entry"]["level"] == "error":
                self.errors.append(str(about["entry"]))
            case "Network.requestWillBeSent":
                self.urls.append(about["request"]["url"])
            case "Network.webSocketCreated":
                self.urls.append(about["url"])
            case "Network.webSocketFrameReceived":
                self.received += len(about["response"]["payloadData"]) * 3 // 4  # base64


@contextmanager
def opened(profile: Path, *more: str) -> Iterator[Page]:
    """Start Chromium with an empty page."""
    if PROGRAM is None:
        raise LookupError("Chromium is not installed")
    words = [PROGRAM, *_QUIET, *more, f"--user-data-dir={profile}", "about:blank"]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(words, stdout=quiet, stderr=quiet) as process:
        try:
            yield Page(connect(_address(profile), max_size=None, ping_interval=None))
        finally:
            process.terminate()


def _address(profile: Path) -> str:
    """Return where the developer tools of the first page are."""
    end = time.monotonic() + _PATIENCE_S
    while time.monotonic() < end:
        time.sleep(0.2)
        with suppress(OSError, IndexError):
            port = int((profile / "DevToolsActivePort").read_text().split()[0])
            asked = HTTPConnection("127.0.0.1", port)
            asked.request("GET", "/json/list")
            pages = [one for one in json.load(asked.getresponse()) if one["type"] == "page"]
            return str(pages[0]["webSocketDebuggerUrl"])
    raise TimeoutError("Chromium does not answer")

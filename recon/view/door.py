"""Where a browser asks for a map that is being made: a viewer begins when one does.

A drive would lose the time that it takes to start although nobody looks.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler
from importlib.util import find_spec
from pathlib import Path
from socketserver import ThreadingTCPServer
from threading import Lock, Thread
from typing import Any, cast

from recon.core.errors import ReconError, require
from recon.view.guard import Gate
from recon.view.scene import HOST

Say = Callable[[str], object]


def show_beside(run: Path, port: int, say: Say) -> str:
    """Lead browsers to a viewer of a run, which may fail without harm; return the address.

    The viewer is a process of its own with the lowest priority, which ends with this one. ``say``
    gets the address, and what fails, in lines; if nothing can be shown, the address is empty.
    """
    try:
        if find_spec("viser") is None:
            require("viser", extra="view")
        door = _Door(run, port, say)
    except (OSError, ReconError) as error:
        say(f"nothing is shown at {HOST}:{port}: {error}")
        return ""
    Thread(target=door.serve_forever, daemon=True).start()
    say(f"{door.gate.url} until the run ends")
    return door.gate.url


class _Door(ThreadingTCPServer):
    """Sends browsers to the viewer of a run, and starts it for the first."""

    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, run: Path, port: int, say: Say) -> None:
        super().__init__((HOST, port), _Caller)
        self.gate = Gate(self.server_address[1])
        beside = ["--port", "0", "--beside", str(os.getpid())]
        self._words = [sys.executable, "-m", "recon", "view", str(run), *beside]
        self._say, self._starting, self._url = say, Lock(), ""
        self._viewer: subprocess.Popen[str] | None = None

    def viewer_url(self) -> str:
        """Return the address of the viewer; empty = there is none, and it is said why."""
        with self._starting:
            if self._viewer is None or self._viewer.poll() is not None:
                try:
                    self._url = self._start()
                except OSError as error:
                    self._url = ""
                    self._say(f"no viewer could be started: {error}")
            return self._url

    def handle_error(self, *_: object) -> None:
        """Leave alone what became of a browser: it may go while it is answered."""

    def _start(self) -> str:
        quiet, pipe = subprocess.DEVNULL, subprocess.PIPE
        how: Any = {"stdin": quiet, "stdout": quiet, "stderr": pipe, "text": True}
        self._viewer = viewer = subprocess.Popen(self._words, **how)
        os.setpriority(os.PRIO_PROCESS, viewer.pid, 19)  # it gets the time that is left
        lines: Any = viewer.stderr
        for line in lines:
            if line.startswith("http"):
                Thread(target=self._pass_on, args=(lines,), daemon=True).start()
                return str(line.split()[0])
            self._say(line.rstrip())
        viewer.wait()
        return ""

    def _pass_on(self, lines: Any) -> None:
        for line in lines:
            self._say(line.rstrip())


class _Caller(BaseHTTPRequestHandler):
    """What a browser asks for."""

    timeout = 10.0  # of one that connects and asks for nothing

    def do_GET(self) -> None:
        door = cast("_Door", self.server)
        admitted = door.gate.admits(self.path, self.headers.get_all("Host", []))
        url = door.viewer_url() if admitted else ""
        self.send_response((302 if url else 503) if admitted else 403)
        self.send_header("Content-Length", "0")
        self.send_header("Cache-Control", "no-store")
        self.send_header("Referrer-Policy", "no-referrer")
        if url:
            self.send_header("Location", url)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Leave the words to the run."""

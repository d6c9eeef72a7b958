"""A viewer with a small scene, in this process, and its page as a program asks for it."""

import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from time import monotonic, sleep
from types import SimpleNamespace
from urllib.parse import urlsplit

import numpy as np
import pytest

from recon.core.values import PointCloud
from recon.report.scene import Points, Scene
from recon.view.server import Viewer
from tests.scenery import chromium


class Served:
    """A viewer that does what is asked for, in a thread, and what became of that."""

    def __init__(self, viewer: Viewer) -> None:
        self.viewer, self.url = viewer, viewer.url
        self.host, self.path = urlsplit(viewer.url).netloc, urlsplit(viewer.url).path
        self.port = urlsplit(viewer.url).port
        self.ended: BaseException | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        try:
            while not self._stop.is_set():
                self.viewer.serve(0.02)
        except BaseException as error:  # noqa: BLE001 - whatever ends it
            self.ended = error

    def pages(self) -> int:
        """Return how many pages are connected."""
        return len(self.viewer._server._websock_server._live_connections)

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()


def until(what: Callable[[], object], seconds: float = 60.0) -> object:
    """Wait for something to be true, and return it."""
    end = monotonic() + seconds
    while not (found := what()) and monotonic() < end:
        sleep(0.02)
    return found


def comes(page: chromium.Page, what: Callable[[], object]) -> object:
    """Follow a page until something is true."""
    return until(lambda: page.wait(0.05) or what())


class Views:
    """Keyframes that have everything in view."""

    T_map_camera, points = (np.eye(4), np.eye(4)), {}

    def outline(self, _: int, depth_m: float) -> np.ndarray:
        corners = depth_m * np.array([(-1.0, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)])
        return np.stack([np.zeros((4, 3)), corners], axis=1)

    def sees(self, *_: object) -> bool:
        return True

    def look(self, number: int) -> tuple[list[str], None]:
        return [f"keyframe {number}"], None


def small_scene(count: int = 1000, **how: object) -> Scene:
    rng = np.random.default_rng(0)
    cloud = PointCloud(
        rng.random((count, 3), np.float32), rng.integers(0, 255, (count, 3), np.uint8), frame="map"
    )
    return Scene((Points("0", cloud),), lines=["a scene"], keyframes=Views(), **how)


@contextmanager
def serving() -> Iterator[Served]:
    pytest.importorskip("viser", reason="the extra view is not installed")
    with closing(Viewer(0)) as viewer:
        viewer.show(Path("run"), small_scene())
        one = Served(viewer)
        yield one
        one.stop()
        assert one.ended is None


@pytest.fixture
def served() -> Iterator[Served]:
    """A viewer for one test, which may change what is shown."""
    with serving() as one:
        yield one


@pytest.fixture(scope="module")
def standing() -> Iterator[Served]:
    """A viewer for all tests that only ask for its page."""
    with serving() as one:
        yield one


@pytest.fixture
def protocol() -> str:
    viser: SimpleNamespace = pytest.importorskip("viser")
    return f"viser-v{viser.__version__}"

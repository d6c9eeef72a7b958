"""The page in the browser, served to this machine alone; the only file that knows viser."""

from __future__ import annotations

import io
import logging
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any, Final

import numpy as np

from recon.core.errors import OutputError, require
from recon.core.values import UNKNOWN, OccupancyGrid
from recon.core.values.arrays import Float64
from recon.view.scene import HOST, MOST_POINTS, Points, Scene, colours, first_view, halvings, pick

_OURS: Final = re.compile(r"http://(127\.0\.0\.1|localhost):\d+")
_LAYERS: Final = ("cloud", "grid", "mesh", "path")
_COLOURINGS: Final = ("image", "height", "sigma", "age", "session")
FIRST_POINTS: Final = 100_000  # until a browser has them, and asks for more
_FLAT: Final[Any] = {"precision": "float32", "point_shading": "flat"}
_LINE: Final[Any] = {"thickness": 3.0, "thickness_units": "screen"}


class Viewer:
    """Shows scenes of runs at ``url``; `ReconError` without viser, or where the port is taken."""

    def __init__(self, port: int) -> None:
        viser: Any = require("viser", extra="view")
        try:
            socket.create_server((HOST, port)).close()
        except OSError as error:
            what, where, hint = "cannot serve here", f"{HOST}:{port}", "give another --port"
            raise OutputError(what, where=where, got=error.strerror, hint=hint) from error
        logging.getLogger("websockets").addHandler(logging.NullHandler())  # a browser may vanish
        with redirect_stdout(io.StringIO()), _for_pages_of_this_machine():
            self._server = viser.ViserServer(HOST, port, "recon", verbose=False)
        self.url = f"http://{HOST}:{self._server.get_port()}"
        self.looked_at = False  # by a browser
        self._scenes: dict[Path, Scene] = {}
        self._parts: list[Points] = []
        self._keyframes: list[tuple[Any, int]] = []  # each by its views, and its number there
        self._drawn: dict[str, tuple[Any, ...]] = {}  # what each node was made of
        self._eye_m: Float64 = np.zeros(3)
        self._wanted: dict[str, Any] = {}
        self._news = Event()
        self._lay_out()

    def show(self, run: Path, scene: Scene) -> None:
        """Show the scene of a run, in place of its earlier one."""
        if scene.points and not self._parts:
            self._eye_m, centre = first_view(scene)
            self._server.initial_camera.position = self._eye_m
            self._server.initial_camera.look_at = centre
        self._scenes[run] = scene
        scenes = self._scenes.values()
        self._parts = [part for one in scenes for part in one.points]
        views = [one.keyframes for one in scenes if one.keyframes is not None]
        self._keyframes = [(of, n) for of in views for n in range(len(of.T_map_camera))]
        known = [by for by in _COLOURINGS if all(p.values(by) is not None for p in self._parts)]
        self._by.options, last = known, len(self._keyframes) - 1
        self._text.content = "\n\n".join("  \n".join(one.lines) for one in scenes)
        self._slider.max, self._slider.disabled = max(1, last), last < 0
        self._draw()

    def serve(self, seconds: float) -> None:
        """Do what is asked for in the browser; wait for it as long as this."""
        self._news.wait(seconds)
        self._news.clear()
        wanted = {name: self._wanted.pop(name) for name in [*self._wanted]}
        self._eye_m = wanted.get("eye", self._eye_m)
        self.looked_at |= "eye" in wanted
        place_m = pick(self._parts, *wanted["ray"]) if "ray" in wanted else None
        if self._keyframes and (place_m is not None or "keyframe" in wanted):
            self._choose(wanted.get("keyframe"), place_m)
        if wanted:
            self._draw()

    def close(self) -> None:
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def _note(self, **wanted: Any) -> None:
        # For `serve`, whose thread does all work; what we set comes from no client: None.
        self._wanted.update({name: one for name, one in wanted.items() if one is not None})
        self._news.set()

    def _lay_out(self) -> None:
        gui, scene = self._server.gui, self._server.scene
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._text = gui.add_markdown("nothing to be seen yet")
        self._by = gui.add_dropdown("Colours", _COLOURINGS[:1])
        self._legend = gui.add_markdown("")
        self._layers = [
            (gui.add_checkbox(f"Show {name}", name != "mesh"), scene.add_frame(f"/{name}", False))
            for name in _LAYERS
        ]
        self._slider = gui.add_slider("Keyframe", 0, 1, 1, 0, disabled=True)
        self._said = gui.add_markdown("Move the slider, or click into the scene.")
        self._image = gui.add_image(np.zeros((1, 1, 3), np.uint8), format="jpeg", visible=False)
        for control in (self._by, *(box for box, _ in self._layers)):
            control.on_update(lambda _: self._note(drawn=True))
        self._slider.on_update(lambda e: self._note(keyframe=e.client and e.target.value))
        scene.on_click()(lambda e: self._note(ray=np.array([e.ray_origin, e.ray_direction])))
        self._server.on_client_connect(
            lambda client: client.camera.on_update(lambda c: self._note(eye=np.array(c.position)))
        )

    def _changed(self, name: str, *made_of: Any) -> bool:
        """Return whether something is to be drawn, as it is made of other values than before."""
        self._kept.add(name)
        before, self._drawn[name] = self._drawn.get(name), made_of
        return before != made_of

    def _draw(self) -> None:
        for box, frame in self._layers:
            frame.visible = box.value
        self._kept: set[str] = set()
        if self._parts:
            self._draw_clouds()
        for number, scene in enumerate(self._scenes.values()):
            self._draw_rest(number, scene)
        for name in {*self._drawn} - self._kept:
            self._server.scene.remove_by_name(name)
            del self._drawn[name]

    def _draw_clouds(self) -> None:
        by, parts, scenes = self._by.value, self._parts, enumerate(self._scenes.values())
        if self._changed("colours", by, *parts):
            self._colours, self._legend.content = colours(parts, by)
        halved = halvings(parts, self._eye_m, MOST_POINTS if self.looked_at else FIRST_POINTS)
        named = {f"/cloud/{n}_{part.name}": one for n, one in scenes for part in one.points}
        for name, part, rgb, times in zip(named, parts, self._colours, halved, strict=True):
            if self._changed(name, part, by, times):
                xyz, shown = part.cloud.xyz[:: 1 << times], rgb[:: 1 << times]
                # Fewer points are larger, so that the surface stays closed.
                how = {"point_size": named[name].spacing_m * 2 ** (times / 2), **_FLAT}
                self._server.scene.add_point_cloud(name, xyz, shown, **how)

    def _draw_rest(self, number: int, scene: Scene) -> None:
        api, by, mesh = self._server.scene, self._by.value, scene.mesh
        for part, (grid, height_m) in enumerate(scene.grids):
            name = f"/grid/{number}_{part}"
            if self._changed(name, grid):
                _add_grid(api, name, grid, height_m + 0.01 * scene.spacing_m * part)
        if mesh is not None and self._changed(name := f"/mesh/{number}", mesh):
            trimesh = require("trimesh", extra="view")
            how: Any = {"vertex_colors": mesh.rgb, "process": False}
            api.add_mesh_trimesh(name, trimesh.Trimesh(mesh.vertices, mesh.faces, **how))
        for path in scene.paths:
            name = f"/path/{number}_{path.name}"
            if self._changed(name, path, by):
                (own,), _ = colours([path], by if by in ("age", "session") else "image")
                pairs = [np.stack([a[:-1], a[1:]], axis=1) for a in (path.cloud.xyz, own)]
                api.add_line_segments(name, *pairs, **_LINE)

    def _choose(self, keyframe: int | None, place_m: Float64 | None) -> None:
        """Show a keyframe and who saw it, or a place and the nearest keyframe that saw that."""
        known, api = self._keyframes, self._server.scene
        eyes_m = np.array([of.T_map_camera[n][:3, 3] for of, n in known])
        place_m = eyes_m[keyframe] if place_m is None else place_m
        seen = [k for k, (of, n) in enumerate(known) if of.sees(n, place_m)]
        ends = np.array([(place_m, eyes_m[k]) for k in seen]).reshape(-1, 2, 3)
        api.add_line_segments("/path/seen", ends, (255, 213, 79), **_LINE)
        text = f"{np.round(place_m, 1)} m was seen by keyframes {seen or 'none'}"
        if keyframe is None and seen:
            keyframe = min(seen, key=lambda k: float(np.linalg.norm(eyes_m[k] - place_m)))
            self._slider.value = keyframe
        if keyframe is not None:
            of, number = known[keyframe]
            lines, image = of.look(number)
            text, self._image.visible = "  \n".join([*lines, text]), image is not None
            self._image.image = self._image.image if image is None else image
        self._said.content = text


@contextmanager
def _for_pages_of_this_machine() -> Iterator[None]:
    """Let what is served meanwhile refuse other sites, whose pages the same browser may show.

    viser asks nobody where a connection comes from, and hands websockets no list of who may.
    """
    library: Any = require("websockets.asyncio.server", extra="view")
    serve = library.serve
    library.serve = partial(serve, origins=[None, _OURS])  # None: no browser
    try:
        yield
    finally:
        library.serve = serve


def _add_grid(api: Any, name: str, grid: OccupancyGrid, height_m: float) -> None:
    from recon.report.style import colour_grid  # noqa: PLC0415 - not for the first points

    size_m = np.array(grid.cells.shape[::-1]) * grid.resolution_m
    known = np.where(grid.cells[::-1] == UNKNOWN, 0, 255).astype(np.uint8)
    image, middle_m = np.dstack([colour_grid(grid), known]), np.array(grid.origin_m) + size_m / 2
    # viser shows images from behind, with y down.
    where: Any = {"wxyz": (0.0, 1.0, 0.0, 0.0), "position": (*middle_m, height_m)}
    api.add_image(name, image, *size_m.tolist(), **where)

"""The page in the browser, made by viser, and what is asked for in it."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from threading import Event
from typing import Any, Final

import numpy as np

from recon.core.errors import require
from recon.core.values import UNKNOWN, OccupancyGrid, PointCloud
from recon.core.values.arrays import Float64
from recon.report.scene import (
    COLOURINGS,
    Points,
    Scene,
    colours,
    first_view,
    known_colourings,
    near_others,
)
from recon.view.guard import Guard, stop

MOST_POINTS: Final = 1_500_000  # in the browser: about 25 MB
FIRST_POINTS: Final = 100_000  # until a browser has them, and asks for more
_TILE_VOXELS: Final = 256  # edge of what is thinned together
_CLICK_RAD: Final = 0.006  # about five pixels of a screen
_HALF_VIEW: Final = (0.9, 0.7)  # tangents across and up of what viser's page has in view at first
# Shown at first. A grid is flat, and the ground is not: behind a bend it would hide the road.
_LAYERS: Final = {"cloud": True, "grid": False, "mesh": False, "path": True}
_FLAT: Final[Any] = {"precision": "float32", "point_shading": "flat"}
_LINE: Final[Any] = {"thickness": 3.0, "thickness_units": "screen"}


class Viewer:
    """Shows scenes of runs at ``url``, which nobody else knows.

    `ReconError`: viser is missing, or is not as it was tested, or the port is taken.
    """

    def __init__(self, port: int) -> None:
        viser: Any = require("viser", extra="view")
        logging.getLogger("websockets").addHandler(logging.NullHandler())  # a browser may vanish
        self._controls: dict[str, Any] = {}
        guard = Guard(viser, port, self._offers)
        self._server, self.url = guard.start(viser), guard.url
        self.looked_at = False  # by a browser
        self._scenes: dict[Path, Scene] = {}
        self._parts: list[Points] = []
        self._keyframes: list[tuple[Any, int]] = []  # each by its views, and its number there
        self._known: list[str] = [*COLOURINGS[:1]]  # of colourings
        self._drawn: dict[str, tuple[Any, ...]] = {}  # what each node was made of
        self._eye_m: Float64 = np.zeros(3)
        self._wanted: dict[str, Any] = {}
        self._news = Event()
        self._lay_out()

    def show(self, run: Path, scene: Scene) -> None:
        """Show the scene of a run, in place of its earlier one."""
        if scene.points and not self._parts:
            xyz = np.concatenate([part.cloud.xyz[::16] for part in scene.points])
            self._eye_m, centre = first_view(xyz[near_others(xyz)], _HALF_VIEW)
            self._server.initial_camera.position = self._eye_m
            self._server.initial_camera.look_at = centre
        self._scenes[run] = scene
        scenes = self._scenes.values()
        self._parts = [part for one in scenes for part in one.points]
        views = [one.keyframes for one in scenes if one.keyframes is not None]
        self._keyframes = [(of, n) for of in views for n in range(len(of.T_map_camera))]
        self._known, last = known_colourings(self._parts), len(self._keyframes) - 1
        self._by.options = self._known
        self._text.content = "<br>".join(_html(one.lines) for one in scenes)
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
        stop(self._server)

    def _note(self, **wanted: Any) -> None:
        # For `serve`, whose thread does all work; what we set comes from no client: None.
        self._wanted.update({name: one for name, one in wanted.items() if one is not None})
        self._news.set()

    def _offers(self, control: Any, value: Any) -> bool:
        known = self._controls.get(control)
        if known is None or known is self._by:
            return known is not None and value in known.options
        if known is self._slider:
            return type(value) is int and not known.disabled and 0 <= value <= known.max
        return type(value) is bool

    def _lay_out(self) -> None:
        gui, scene = self._server.gui, self._server.scene
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._text = gui.add_html(_html(["nothing to be seen yet"]))
        self._by = gui.add_dropdown("Colours", COLOURINGS[:1])
        self._legend = gui.add_html("")
        self._layers = [
            (gui.add_checkbox(f"Show {name}", shown), scene.add_frame(f"/{name}", False))
            for name, shown in _LAYERS.items()
        ]
        self._slider = gui.add_slider("Keyframe", 0, 1, 1, 0, disabled=True)
        self._said = gui.add_html(_html(["Move the slider, or click into the scene."]))
        self._image = gui.add_image(np.zeros((1, 1, 3), np.uint8), format="jpeg", visible=False)
        drawn = (self._by, *(box for box, _ in self._layers))
        self._controls = {one._impl.uuid: one for one in (*drawn, self._slider)}
        for control in drawn:
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
        # What was chosen may be older than what is known now.
        self._colour = self._by.value if self._by.value in self._known else self._known[0]
        self._kept: set[str] = set()
        if self._parts:
            self._draw_clouds()
        for number, scene in enumerate(self._scenes.values()):
            self._draw_rest(number, scene)
        for name in {*self._drawn} - self._kept:
            self._server.scene.remove_by_name(name)
            del self._drawn[name]

    def _draw_clouds(self) -> None:
        by, parts, scenes = self._colour, self._parts, enumerate(self._scenes.values())
        if self._changed("colours", by, *parts):
            self._colours, legend = colours(parts, by)
            self._legend.content = _html([legend])
        halved = halvings(parts, self._eye_m, MOST_POINTS if self.looked_at else FIRST_POINTS)
        named = {f"/cloud/{n}_{part.name}": one for n, one in scenes for part in one.points}
        for name, part, rgb, times in zip(named, parts, self._colours, halved, strict=True):
            if self._changed(name, part, by, times):
                xyz, shown = part.cloud.xyz[:: 1 << times], rgb[:: 1 << times]
                # Fewer points are larger, so that the surface stays closed.
                how = {"point_size": named[name].spacing_m * 2 ** (times / 2), **_FLAT}
                self._server.scene.add_point_cloud(name, xyz, shown, **how)

    def _draw_rest(self, number: int, scene: Scene) -> None:
        api, by, mesh = self._server.scene, self._colour, scene.mesh
        for part, (grid, height_m) in enumerate(scene.grids):
            name = f"/grid/{number}_{part}"
            if self._changed(name, grid):
                _add_grid(api, name, grid, height_m + 0.01 * scene.spacing_m * part)
        if mesh is not None and self._changed(name := f"/mesh/{number}", mesh):
            trimesh = require("trimesh", extra="view")
            shown = trimesh.Trimesh(
                mesh.vertices, mesh.faces, vertex_colors=mesh.rgb, process=False
            )
            api.add_mesh_trimesh(name, shown)
        for path in scene.paths:
            name = f"/path/{number}_{path.name}"
            if self._changed(name, path, by):
                (own,), _ = colours([path], by if by in ("age", "session") else "image")
                pairs = [np.stack([a[:-1], a[1:]], axis=1) for a in (path.cloud.xyz, own)]
                api.add_line_segments(name, *pairs, **_LINE)

    def _choose(self, keyframe: int | None, place_m: Float64 | None) -> None:
        """Show a keyframe and who saw it, or a place and the nearest keyframe that saw that."""
        known, api = self._keyframes, self._server.scene
        keyframe = keyframe and min(keyframe, len(known) - 1)  # of one there may be a slider to 1
        eyes_m = np.array([of.T_map_camera[n][:3, 3] for of, n in known])
        place_m = eyes_m[keyframe] if place_m is None else place_m
        seen = [k for k, (of, n) in enumerate(known) if of.sees(n, place_m)]
        ends = np.array([(place_m, eyes_m[k]) for k in seen]).reshape(-1, 2, 3)
        api.add_line_segments("/path/seen", ends, (255, 213, 79), **_LINE)
        lines = [f"{np.round(place_m, 1)} m was seen by keyframes {seen or 'none'}"]
        if keyframe is None and seen:
            keyframe = min(seen, key=lambda k: float(np.linalg.norm(eyes_m[k] - place_m)))
            self._slider.value = keyframe
        if keyframe is not None:
            of, number = known[keyframe]
            said, image = of.look(number)
            lines, self._image.visible = [*said, *lines], image is not None
            self._image.image = self._image.image if image is None else image
        self._said.content = _html(lines)


def cut(cloud: PointCloud, spacing_m: float) -> tuple[Points, ...]:
    """Cut a cloud into square tiles, seen from above."""
    keys = (cloud.xyz[:, :2] // (_TILE_VOXELS * spacing_m)).astype(np.int64) @ [1 << 32, 1]
    order = np.argsort(keys, kind="stable")
    tiles = np.split(order, np.flatnonzero(np.diff(keys[order])) + 1)
    return tuple(Points(f"{keys[own[0]]}", cloud.select(own)) for own in tiles if len(own))


def halvings(parts: Sequence[Points], eye_m: Float64, limit: int = MOST_POINTS) -> list[int]:
    """Return how often to halve each part to keep ``limit``: two more at twice the distance."""
    sizes = np.array([len(part.cloud) for part in parts])
    places = np.array([part.cloud.xyz[len(part.cloud) // 2] for part in parts])
    distance_m = np.maximum(np.linalg.norm(places - eye_m, axis=1), 1e-3)
    whole_m, times = float(distance_m.max()), np.zeros(len(parts), np.int64)
    while (-(-sizes >> times)).sum() > max(limit, len(parts)):  # rounded up
        whole_m /= np.sqrt(2.0)
        times = np.ceil(2.0 * np.log2(np.maximum(distance_m / whole_m, 1.0))).astype(np.int64)
    return [int(number) for number in times]


def pick(parts: Sequence[Points], origin_m: Float64, direction: Float64) -> Float64 | None:
    """Return the nearest point (3,) that a ray passes close by; None where there is none."""
    best_m, best = np.inf, None
    for part in parts:
        xyz = part.cloud.xyz - origin_m
        along_m = xyz @ direction
        aside_m = np.linalg.norm(xyz - along_m[:, None] * direction, axis=1)
        along_m[aside_m > _CLICK_RAD * along_m] = np.inf
        if along_m.min() < best_m:
            best_m, best = along_m.min(), part.cloud.xyz[along_m.argmin()].astype(np.float64)
    return best


def _html(lines: Iterable[str]) -> str:
    """Return lines as a page shows them, of which none is markup: they name files of others."""
    text = "<br>".join(map(escape, lines))
    return f'<div style="padding: 0 10px; font-size: 14px; overflow-wrap: anywhere">{text}</div>'


def _add_grid(api: Any, name: str, grid: OccupancyGrid, height_m: float) -> None:
    from recon.report.style import colour_grid  # noqa: PLC0415 - not for the first points

    size_m = np.array(grid.cells.shape[::-1]) * grid.resolution_m
    known = np.where(grid.cells[::-1] == UNKNOWN, 0, 255).astype(np.uint8)
    image, middle_m = np.dstack([colour_grid(grid), known]), np.array(grid.origin_m) + size_m / 2
    # viser shows images from behind, with y down.
    position_m = (*middle_m, height_m)
    api.add_image(name, image, *size_m.tolist(), wxyz=(0.0, 1.0, 0.0, 0.0), position=position_m)

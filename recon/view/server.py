"""The page in the browser, made by viser, and what is asked for in it."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from html import escape
from pathlib import Path
from threading import Event
from typing import Any, Final

import numpy as np

from recon.core.errors import require
from recon.core.geometry.se3 import quaternion_from_rotation
from recon.core.text import counted
from recon.core.values import UNKNOWN, OccupancyGrid, PointCloud
from recon.core.values.arrays import Float64
from recon.map.ground.surface import GroundSurface
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
from recon.view.tools import LIMITS, TOOLS, Limits, ends_of, limited, measure, within

MOST_POINTS: Final = 1_500_000  # in the browser: about 25 MB
FIRST_POINTS: Final = 100_000  # until a browser has them, and asks for more
_TILE_VOXELS: Final = 256  # edge of what is thinned together
_CLICK_RAD: Final = 0.006  # about five pixels of a screen
_HALF_VIEW: Final = (0.9, 0.7)  # tangents across and up of what viser's page has in view at first
_MOST_CAMERAS: Final = 36  # that are drawn
_MOST_CELLS: Final = 150_000  # of a grid: about 13 MB
_STEP: Final = 0.01  # of limits
_MOST_PLACES: Final = 100  # of a measurement
_NO_POINT: Final = "none"
_SEEN_BY: Final = "who saw it"
_LAYERS: Final = {"cloud": True, "grid": False, "mesh": False, "path": True, "cameras": True}
_FLAT: Final[Any] = {"precision": "float32", "point_shading": "flat"}
_LINE: Final[Any] = {"thickness": 3.0, "thickness_units": "screen"}
_YELLOW: Final = (255, 213, 79)
_SQUARE: Final = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])


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
        self._shown: dict[str, tuple[Points, Any]] = {}  # within limits, and their colours
        self._places: list[PointCloud] = []  # that were clicked to measure, of one point each
        self._keyframes: list[tuple[Any, int]] = []  # each by its views, and its number there
        self._cameras = Points("", PointCloud(np.zeros((0, 3), np.float32)))  # that are drawn
        self._control: dict[str, Float64] = {}  # control points, by their names
        self._through: tuple[Any, int, Any] | None = None  # the keyframe that is shown, its image
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
        self._spacing_m = max(one.spacing_m for one in scenes)
        self._parts = [part for one in scenes for part in one.points]
        views = [one.keyframes for one in scenes if one.keyframes is not None]
        self._keyframes = [(of, n) for of in views for n in range(len(of.T_map_camera))]
        self._control = {name: place for of in views for name, place in of.points.items()}
        self._point.options = (_NO_POINT, *self._control)
        self._point.visible = bool(self._control)
        self._known, last = known_colourings(self._parts), len(self._keyframes) - 1
        self._by.options = self._known
        self._text.content = "<br>".join(_html(one.lines) for one in scenes)
        self._slider.max, self._slider.disabled = max(1, last), last < 0
        for by, limits in self._limited().items():
            (low, high), one = ends_of(self._parts, by), self._limits[by]
            one.min, one.max, one.disabled = float(low), max(high, low + 1.0), low == high
            one.value = tuple(np.clip(limits, one.min, one.max).tolist())
        self._draw()

    def serve(self, seconds: float) -> None:
        """Do what is asked for in the browser; wait for it as long as this."""
        self._news.wait(seconds)
        self._news.clear()
        wanted = {name: self._wanted.pop(name) for name in [*self._wanted]}
        self._eye_m = wanted.get("eye", self._eye_m)
        self.looked_at |= "eye" in wanted
        if "clear" in wanted:
            self._places = []
        if "ray" in wanted:
            self._click(*wanted["ray"])
        if "point" in wanted:
            self._residual.content = ""
            if (name := self._point.value) in self._control:
                self._residual.content = _html([f"Click {name} in the image."])
                self._choose(None, self._control[name])
        if "keyframe" in wanted and self._keyframes:
            self._choose(wanted["keyframe"], None)
        if wanted:
            self._draw()

    def close(self) -> None:
        stop(self._server)

    def _note(self, **wanted: Any) -> None:
        # For `serve`, whose thread does all work; what we set comes from no client: None.
        self._wanted.update({name: one for name, one in wanted.items() if one is not None})
        self._news.set()

    def _offers(self, control: Any, value: Any) -> bool:
        one = self._controls.get(control)
        if one is None or one.disabled:
            return False
        if hasattr(one, "options"):
            return value in one.options
        if type(one.value) is bool:  # of a button, too
            return type(value) is bool
        given, kind = [value], type(one.value)
        if kind is tuple:
            given, kind = value, float
        fits = type(given) is list and len(given) == np.size(one.value)
        fits = fits and {*map(type, given)} <= {int, kind}
        return bool(fits and one.min <= given[0] <= given[-1] <= one.max)

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
        self._size = gui.add_slider("Point size", 0.25, 4.0, 0.25, 1.0)
        with gui.add_folder("Show only", expand_by_default=False):
            self._limits = {
                by: gui.add_multi_slider(name, 0.0, 1.0, _STEP, (0.0, 1.0), disabled=True)
                for by, name in LIMITS.items()
            }
        self._tool = gui.add_dropdown("A click shows", (_SEEN_BY, *TOOLS))
        self._measured = gui.add_html("")
        clear = gui.add_button("Clear what is measured")
        self._point = gui.add_dropdown("Control point", (_NO_POINT,), visible=False)
        self._residual = gui.add_html("")
        self._slider = gui.add_slider("Keyframe", 0, 1, 1, 0, disabled=True)
        self._said = gui.add_html(_html(["Move the slider, or click into the scene."]))
        self._image = gui.add_image(np.zeros((1, 1, 3), np.uint8), format="jpeg", visible=False)
        boxes = [box for box, _ in self._layers]
        drawn = (self._by, *boxes, self._size, *self._limits.values(), self._tool)
        self._controls = {one._impl.uuid: one for one in (*drawn, clear, self._point, self._slider)}
        for control in drawn:
            control.on_update(lambda _: self._note(drawn=True))
        self._point.on_update(lambda _: self._note(point=True))
        clear.on_click(lambda _: self._note(clear=True))
        self._slider.on_update(lambda e: self._note(keyframe=e.client and e.target.value))
        scene.on_click()(lambda e: self._note(ray=np.array([e.ray_origin, e.ray_direction])))
        self._server.on_client_connect(
            lambda client: client.camera.on_update(lambda c: self._note(eye=np.array(c.position)))
        )

    def _limited(self) -> Limits:
        """Return the limits of points; one at its end lets everything through."""
        return {
            by: (low if low > one.min else -np.inf, high if high < one.max else np.inf)
            for by, one in self._limits.items()
            for low, high in [one.value]
        }

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
        limits = self._limited()
        if self._parts:
            self._draw_clouds(limits)
        for number, scene in enumerate(self._scenes.values()):
            self._draw_rest(number, scene, limits)
        if self._keyframes:
            self._draw_cameras()
        if self._through is not None and self._point.value in self._control:
            self._draw_image(*self._through)
        self._measured.content = ""
        if self._places and self._tool.value in TOOLS:
            self._draw_measured()
        for name in {*self._drawn} - self._kept:
            self._server.scene.remove_by_name(name)
            del self._drawn[name]

    def _draw_clouds(self, limits: Limits) -> None:
        by, parts, scenes = self._colour, self._parts, enumerate(self._scenes.values())
        if new := self._changed("colours", by, *parts):
            self._colours, legend = colours(parts, by)
            self._legend.content = _html([legend])
        named = {f"/cloud/{n}_{part.name}": one for n, one in scenes for part in one.points}
        if self._changed("limits", limits, *parts) or new:
            kept = [limited(*one, limits) for one in zip(parts, self._colours, strict=True)]
            self._shown = {n: one for n, one in zip(named, kept, strict=True) if len(one[1])}
        most = MOST_POINTS if self.looked_at else FIRST_POINTS
        halved = halvings([part for part, _ in self._shown.values()], self._eye_m, most)
        for (name, (part, rgb)), times in zip(self._shown.items(), halved, strict=True):
            # Fewer points are larger, so that the surface stays closed.
            size_m = self._size.value * named[name].spacing_m * 2 ** (times / 2)
            if self._changed(name, part, by, times):
                xyz, shown = part.cloud.xyz[:: 1 << times], rgb[:: 1 << times]
                self._server.scene.add_point_cloud(name, xyz, shown, point_size=size_m, **_FLAT)
            self._server.scene.get_handle_by_name(name).point_size = size_m

    def _draw_rest(self, number: int, scene: Scene, limits: Limits) -> None:
        api, by, mesh = self._server.scene, self._colour, scene.mesh
        for part, (grid, ground) in enumerate(scene.grids):
            name = f"/grid/{number}_{part}"
            if self._changed(name, grid, ground):
                _add_grid(api, name, grid, ground)
        if mesh is not None and self._changed(name := f"/mesh/{number}", mesh):
            _add_mesh(api, name, mesh.vertices, mesh.faces, mesh.rgb)
        for path in scene.paths:
            name = f"/path/{number}_{path.name}"
            if self._changed(name, path, by, limits):
                (own,), _ = colours([path], by if by in ("age", "session") else "image")
                both = np.all([(keep := within(path, limits))[:-1], keep[1:]], axis=0)
                pairs = [np.stack([a[:-1], a[1:]], axis=1)[both] for a in (path.cloud.xyz, own)]
                api.add_line_segments(name, *pairs, **_LINE)

    def _draw_cameras(self) -> None:
        """Draw some keyframes as cameras, small enough to be told apart, to be clicked at."""
        last = len(self._keyframes) - 1
        numbers = np.unique(np.linspace(0, last, min(last + 1, _MOST_CAMERAS)).astype(np.int32))
        known = [self._keyframes[n] for n in numbers]
        if self._changed("/cameras/all", *known):
            eyes_m = np.array([of.T_map_camera[n][:3, 3] for of, n in known])
            steps_m = np.linalg.norm(np.diff(eyes_m, axis=0), axis=1)
            self._camera_m = max(self._spacing_m, 0.3 * float(np.median(steps_m)) if last else 0.0)
            self._cameras = Points("", PointCloud(eyes_m.astype(np.float32), session=numbers))
            lines = np.concatenate([of.outline(n, self._camera_m) for of, n in known])
            self._server.scene.add_line_segments("/cameras/all", lines, _YELLOW, **_LINE)

    def _draw_image(self, of: Any, number: int, image: Any) -> None:
        """Hold the image of a keyframe before its eye, and look at it from there."""
        if self._changed("/control/image", of, number):
            T, lines = of.T_map_camera[number], of.outline(number, self._camera_m / 2)
            (left, right, _, low), middle_m = lines[:4, 1], lines[:4, 1].mean(axis=0)
            size_m = [float(np.linalg.norm(end - left)) for end in (right, low)]
            how = {"wxyz": np.roll(quaternion_from_rotation(T[:3, :3]), 1), "position": middle_m}
            self._server.scene.add_image("/control/image", image, *size_m, **how)
            for client in self._server.get_clients().values():
                with suppress(ValueError):  # what a page says of its camera need not be one
                    client.camera.position, client.camera.look_at = T[:3, 3], middle_m

    def _draw_measured(self) -> None:
        """Show what is measured between the places that were clicked for it."""
        tool, api = self._tool.value, self._server.scene
        xyz = np.concatenate([one.xyz for one in self._places]).astype(np.float64)
        sigma_m = [np.nan if one.sigma_m is None else one.sigma_m[0] for one in self._places]
        grounds = [ground for one in self._scenes.values() for _, ground in one.grids]
        below_m = [float(ground.height_at(xyz[-1:, :2])[0]) for ground in grounds]
        ground_m = next(filter(math.isfinite, below_m), math.nan)
        self._measured.content = _html(measure(tool, xyz, np.array(sigma_m), ground_m))
        if self._changed("/measured/lines", tool, *self._places):
            size_m = 2.0 * self._spacing_m
            shown = xyz + np.array([0.0, 0.0, size_m])  # else points around would hide them
            pairs = np.stack([shown, np.roll(shown, -1, axis=0)], axis=1)
            pairs = pairs[: {"distance": len(pairs) - 1, "height": 0}.get(tool)]
            api.add_line_segments("/measured/lines", pairs, _YELLOW, **_LINE)
            api.add_point_cloud("/measured/lines/ends", shown, _YELLOW, point_size=size_m)

    def _click(self, origin_m: Float64, direction: Float64) -> None:
        """Do what the chosen tool does with the point, or a camera, that a ray meets first."""
        if self._through is not None and (name := self._point.value) in self._control:
            of, number, _ = self._through
            ray = np.stack([origin_m, direction])
            if lines := of.mark(name, number, ray, self._camera_m / 2):
                self._residual.content = _html(lines)
                return
        parts = [part for part, _ in self._shown.values()]  # drawn as squares of their spacing
        found = pick(parts, origin_m, direction, self._spacing_m / 2)
        shown = [self._cameras] if self._layers[-1][0].value else []
        camera = pick(shown, origin_m, direction, self._camera_m)
        if self._tool.value in TOOLS:
            self._places += [] if found is None or len(self._places) >= _MOST_PLACES else [found]
        elif camera is not None and camera.session is not None:
            self._slider.value = keyframe = int(camera.session[0])
            self._choose(keyframe, None)
        elif found is not None and self._keyframes:
            self._choose(None, found.xyz[0].astype(np.float64))

    def _choose(self, keyframe: int | None, place_m: Float64 | None) -> None:
        """Show a keyframe and who saw it, or a place and the nearest keyframe that saw that."""
        known, api = self._keyframes, self._server.scene
        keyframe = keyframe and min(keyframe, len(known) - 1)  # of one there may be a slider to 1
        eyes_m = np.array([of.T_map_camera[n][:3, 3] for of, n in known])
        place_m = eyes_m[keyframe] if place_m is None else place_m
        seen = [k for k, (of, n) in enumerate(known) if of.sees(n, place_m)]
        ends = np.array([(place_m, eyes_m[k]) for k in seen]).reshape(-1, 2, 3)
        api.add_line_segments("/path/seen", ends, _YELLOW, **_LINE)
        where = ", ".join(f"{metre:.1f}" for metre in place_m)
        by = f"{counted(len(seen), 'keyframe')}: {', '.join(map(str, seen))}" if seen else "none"
        lines = [f"The place at {where} m was seen by {by}"]
        if keyframe is None and seen:
            keyframe = min(seen, key=lambda k: float(np.linalg.norm(eyes_m[k] - place_m)))
            self._slider.value = keyframe
        if keyframe is not None:
            of, number = known[keyframe]
            said, image = of.look(number)
            lines, self._image.visible = [*said, *lines], image is not None
            self._image.image = self._image.image if image is None else image
            self._through = None if image is None else (of, number, image[: len(image) // 3])
        self._said.content = _html(lines)


def cut(cloud: PointCloud, spacing_m: float) -> tuple[Points, ...]:
    """Cut a cloud into square tiles, seen from above."""
    keys = (cloud.xyz[:, :2] // (_TILE_VOXELS * spacing_m)).astype(np.int64) @ [1 << 32, 1]
    order = np.argsort(keys, kind="stable")
    tiles = np.split(order, np.flatnonzero(np.diff(keys[order])) + 1)
    return tuple(Points(f"{keys[own[0]]}", cloud.select(own)) for own in tiles if len(own))


def halvings(parts: Sequence[Points], eye_m: Float64, limit: int = MOST_POINTS) -> list[int]:
    """Return how often to halve each part to keep ``limit``: two more at twice the distance."""
    if not parts:
        return []
    sizes = np.array([len(part.cloud) for part in parts])
    places = np.array([part.cloud.xyz[len(part.cloud) // 2] for part in parts])
    distance_m = np.maximum(np.linalg.norm(places - eye_m, axis=1), 1e-3)
    whole_m, times = float(distance_m.max()), np.zeros(len(parts), np.int64)
    while (-(-sizes >> times)).sum() > max(limit, len(parts)):  # rounded up
        whole_m /= np.sqrt(2.0)
        times = np.ceil(2.0 * np.log2(np.maximum(distance_m / whole_m, 1.0))).astype(np.int64)
    return [int(number) for number in times]


def pick(
    parts: Sequence[Points], origin_m: Float64, direction: Float64, radius_m: float = 0.0
) -> PointCloud | None:
    """Return the nearest point, alone, that a ray passes close by; None where there is none."""
    best_m, best = np.inf, None
    for part in parts:
        xyz = part.cloud.xyz - origin_m
        along_m = xyz @ direction
        aside_m = np.linalg.norm(xyz - along_m[:, None] * direction, axis=1)
        along_m[(aside_m > np.maximum(_CLICK_RAD * along_m, radius_m)) | (along_m < 0.0)] = np.inf
        if along_m.min(initial=np.inf) < best_m:
            best_m, best = along_m.min(), part.cloud.select(np.array([along_m.argmin()]))
    return best


def _html(lines: Iterable[str]) -> str:
    """Return lines as a page shows them, of which none is markup: they name files of others."""
    text = "<br>".join(map(escape, lines))
    return f'<div style="padding: 0 10px; font-size: 14px; overflow-wrap: anywhere">{text}</div>'


def _add_grid(api: Any, name: str, grid: OccupancyGrid, ground: GroundSurface) -> None:
    """Drape a grid over the ground, the cells that are known: those of a large one are merged."""
    from recon.report.drive_figures import thin_grid  # noqa: PLC0415 - not for the first points
    from recon.report.style import colour_grid  # noqa: PLC0415

    while (grid.cells != UNKNOWN).sum() > _MOST_CELLS:
        grid = thin_grid(grid, -(-max(grid.cells.shape) // 2))
    row, column = np.nonzero(grid.cells != UNKNOWN)
    corners = np.column_stack([column, row])[:, None] + _SQUARE
    xy = np.concatenate([corners, corners.mean(axis=1, keepdims=True)], axis=1)
    xy = grid.origin_m + grid.resolution_m * xy
    z = ground.height_at(xy.reshape(-1, 2)).reshape(-1, 5) + grid.resolution_m / 2
    z = np.where(np.isfinite(z), z, z[:, 4:])[:, :4]  # of the middle, at the edge of the ground
    known = np.isfinite(z).all(axis=1)
    xyz = np.dstack([xy[:, :4], z])[known].reshape(-1, 3)
    faces = np.arange(len(xyz)).reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    rgb = colour_grid(grid)[::-1][row, column][known].repeat(4, axis=0)
    _add_mesh(api, name, xyz, faces, rgb)


def _add_mesh(api: Any, name: str, xyz: Any, faces: Any, rgb: Any) -> None:
    trimesh = require("trimesh", extra="view")
    api.add_mesh_trimesh(name, trimesh.Trimesh(xyz, faces, vertex_colors=rgb, process=False))

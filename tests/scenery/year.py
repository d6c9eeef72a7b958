"""One street, driven through once a week for a year: what comes, goes, grows and looks different.

Cars park for a week or for months; a hoarding stands from week 14 to 30; a fence goes in week 26; a
tree grows; leaves turn and fall; the sun stands elsewhere, or nowhere in rain. The rig sways
differently each time. All of it follows from the seed of the street and the number of the week.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Any, Final

import numpy as np

from recon.core.geometry import se3
from recon.core.values import StereoPair, Trajectory
from recon.core.values.arrays import Float64, UInt8
from recon.sources.synthetic import SyntheticSource
from recon.street import props
from recon.street.path import camera_poses, centre_line
from recon.street.settings import StreetScene
from recon.street.shapes import Material, Paint, TriangleSoup, at, boxes, merge, move
from recon.street.street import KERB_M, StreetWorld, build_street, street_parts

WEEKS: Final = 52
FIRST_S: Final = 1_736_150_400.0  # Monday, 6 January 2025, 8:00 UTC
WEEK_S: Final = 7 * 86_400.0
SCENE: Final[dict[str, Any]] = {
    "seed": 3, "frames": 48, "path": "straight", "width_px": 512, "height_px": 208,
    "focal_px": 288.0, "smooth_edges": False,
}  # fmt: skip
HOARDING: Final = range(14, 30)  # weeks in which it stands
FENCE_GOES: Final = 26
GREENS: Final = {"spring": (0.9, 1.15, 0.8), "summer": (1, 1, 1), "autumn": (2.2, 1.1, 0.5)}
_BAYS_M: Final = np.arange(-18.0, 140.0, 6.0)
_LANE_M: Final = 4.15


@dataclass(frozen=True)
class ParkedCar:
    """A car in a bay; the same one as long as its ``name`` is the same."""

    name: tuple[int, int, int]  # bay, side, and which of the cars that stand there in turn
    soup: TriangleSoup  # street axes

    @property
    def box_m(self) -> Float64:
        """float64 (2, 3), lowest and highest corner, street axes."""
        corners = self.soup.vertices.reshape(-1, 3)
        return np.stack([corners.min(axis=0), corners.max(axis=0)])


def parked_cars(week: int, seed: int = SCENE["seed"]) -> list[ParkedCar]:
    """Return the cars that stand in the street in a week."""
    cars = []
    for bay, along in enumerate(_BAYS_M.tolist()):
        for side in (0, 1):
            habits = np.random.default_rng([seed, 50, bay, side])
            every, offset = int(habits.choice([1, 2, 4, 13, 60])), int(habits.integers(60))
            turn = (week + offset) // every
            rng = np.random.default_rng([seed, 51, bay, side, turn])
            if rng.random() < 0.45:
                continue
            dx, dy, turned = rng.normal(0.0, [0.25, 0.1, 0.02])
            y = (_LANE_M if side else -_LANE_M) + dy
            T = at(along + 3.0 + dx, y, 0.0, turned + np.pi * side)
            cars.append(ParkedCar((bay, side, turn), move(props.car(rng), T)))
    return cars


def hoarding() -> TriangleSoup:
    """Return boards of 2 m around a site on the right pavement, 12 m long; street axes."""
    rng, boards = np.random.default_rng(70), []
    for x in np.arange(22.0, 34.0, 1.5).tolist():
        colour = tuple(rng.uniform(0.2, 0.8, 3).tolist())
        paint = Paint(Material.POSTER, (colour[0], colour[1], colour[2]), int(rng.integers(2**30)))
        boards.append(boxes([x, -6.3, KERB_M], [x + 1.48, -6.25, KERB_M + 2.0], paint))
    return merge(boards)


def fence() -> TriangleSoup:
    """Return a picket fence on the left pavement, 9 m long; street axes."""
    return move(props.picket_fence(np.random.default_rng(71)), at(16.0, 6.6, KERB_M))


def growing_tree(week: int) -> TriangleSoup:
    """Return a young tree on the right, of 0.6 times its size in January, and 1.1 in December."""
    grown = props.tree(np.random.default_rng(72))
    grown = replace(grown, vertices=grown.vertices * (0.6 + 0.5 * week / WEEKS))
    return move(grown, at(12.0, -6.6, KERB_M))


def season(week: int) -> str:
    """Return winter, spring, summer or autumn."""
    return ("winter", "spring", "summer", "autumn")[((week + 4) % WEEKS) * 4 // WEEKS]


def rains(week: int, seed: int = SCENE["seed"]) -> bool:
    return bool(np.random.default_rng([seed, 52, week]).random() < 0.25)


def street_of(week: int, **scene: Any) -> StreetWorld:
    """Return the street of a week, 0 to 51, and the drive through it; ``scene`` as `StreetScene`.

    Street axes are the same in all weeks: ``T_street_camera`` of two tell where they were.
    """
    settings = StreetScene(**(SCENE | scene))
    parts = street_parts(settings)
    del parts["parked_cars"]
    parts["cars"] = [car.soup for car in parked_cars(week, settings.seed)]
    parts["trees"].append(growing_tree(week))
    parts["hoarding"] = [hoarding()] if week in HOARDING else []
    parts["fence"] = [fence()] if week < FENCE_GOES else []
    soup = _in_season(merge(chain.from_iterable(parts.values())), week)
    road = centre_line(settings, settings.frames * settings.speed_m_per_frame + 170.0)
    # Its phase alone depends on the seed.
    poses = camera_poses(settings.model_copy(update={"seed": settings.seed + 7 * week}), road)
    world = build_street(settings.model_copy(update={"frames": 1}))
    return replace(
        world, settings=settings, soup=soup, T_street_camera=poses, to_sun=_sun(week, settings.seed)
    )


def _in_season(soup: TriangleSoup, week: int) -> TriangleSoup:
    """Return the street with the leaves of the week; most have fallen in winter."""
    now, rgb = season(week), soup.rgb.copy()
    leaves = soup.material == Material.LEAVES
    if now == "winter":
        bare = np.random.default_rng(60).random(len(soup)) < 0.8
        chosen = ~(leaves & bare)
        soup = TriangleSoup(*(values[chosen] for values in vars(soup).values()))
        rgb, leaves = rgb[chosen], leaves[chosen]
        rgb[leaves] *= (1.0, 0.8, 0.8)
        rgb[soup.material == Material.GRASS] *= (1.3, 1.1, 1.0)
    else:
        rgb[leaves] = np.clip(rgb[leaves] * GREENS[now], 0.0, 1.0)
    return replace(soup, rgb=rgb)


def _sun(week: int, seed: int) -> Float64:
    """Return the direction to the sun: low in winter, at another hour each time; high in rain."""
    if rains(week, seed):
        return np.array([0.0, 0.0, 1.0])
    hour = np.random.default_rng([seed, 53, week]).uniform(-1.2, 1.2)
    climb = np.radians(38.0 - 22.0 * np.cos(2 * np.pi * (week + 2) / WEEKS))
    level = np.cos(climb)
    return np.array([level * np.sin(hour), -level * np.cos(hour), np.sin(climb)])


class WeekDrive(SyntheticSource):
    """The drive of a week, stamped with its date; a world (first camera) of its own.

    ``T_street_camera`` (4, 4) of its first frame leads from there to the axes of the street.
    """

    def __init__(self, week: int, **scene: Any) -> None:
        super().__init__(StreetScene(**(SCENE | scene)))
        self.week, self._scene, self.name = week, scene, f"week {week + 1}"

    @cached_property
    def world(self) -> StreetWorld:
        return street_of(self.week, **self._scene)

    @property
    def trajectory(self) -> Trajectory:
        path = self.world.trajectory
        times_s = FIRST_S + self.week * WEEK_S + path.timestamps_s
        return Trajectory(path.T_world_camera, times_s)

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        for pair in super().frames(start):
            time_s = FIRST_S + self.week * WEEK_S + pair.timestamp_s
            images = pair.left, pair.right
            if rains(self.week, self.settings.seed):
                images = tuple(
                    _wet(image, [self.week, pair.index, side]) for side, image in enumerate(images)
                )
            yield replace(pair, left=images[0], right=images[1], timestamp_s=time_s)

    def T_first_street(self) -> Float64:
        """Return float64 (4, 4), from the axes of the street to the world of this drive."""
        return se3.invert(self.world.T_street_camera[0])


def _wet(image: UInt8, seed: list[int]) -> UInt8:
    """Return an image in rain: darker, of less contrast, with streaks of its own."""
    rng, (height, width) = np.random.default_rng(seed), image.shape[:2]
    seen = 0.55 * image.astype(np.float64) + 40.0
    for _ in range(60):
        u, v, long = int(rng.integers(width)), int(rng.integers(height)), int(rng.integers(4, 14))
        seen[v : v + long, u] += 25.0
    return np.asarray(np.clip(seen + rng.normal(0.0, 2.0, seen.shape), 0, 255), np.uint8)

"""An orthophoto shows things at their places, from images that see them."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import PointCloud, RectifiedCamera
from recon.core.values.camera import unproject
from recon.export import orthophoto as made
from recon.export.mesh.views import PosedImage
from recon.export.orthophoto import Canvas, Relief
from recon.io.models.rasters import RasterPlace
from recon.map.ground.surface import GroundSurface

CAMERA = RectifiedCamera(
    focal_px=300.0, cx_px=199.5, cy_px=99.5, cx_right_px=199.5, baseline_m=0.4,
    width_px=400, height_px=200,
)  # fmt: skip
AHEAD = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0.0]])
EYE_M, CELL_M, GSD_M = 1.6, 0.1, 0.04
BOX = np.array([[6.0, 1.0], [8.0, 2.4]])  # of a car, x and y, with a level roof
ROOF_M = 1.0
YARD = RasterPlace(CELL_M, 20, 40, 160, 80)  # 2 to 18 m ahead, 4 m to both sides


def colours(xyz: np.ndarray) -> np.ndarray:
    """Tiles of 0.5 m of random greys; a roof in stripes; sides in red."""
    tile = np.floor(xyz[:, :2] / 0.5).astype(int) % 200
    grey = np.random.default_rng(1).integers(60, 200, (200, 200))[tile[:, 0], tile[:, 1]]
    rgb = np.repeat(grey[:, None], 3, axis=1).astype(float)
    roof = xyz[:, 2] > ROOF_M - 0.01
    rgb[roof] = np.where(np.floor(xyz[roof, :1] / 0.2) % 2 == 0, [40, 90, 200], [200, 200, 90])
    side = (xyz[:, 2] > 0.01) & ~roof
    rgb[side] = 220, 30, 30
    return rgb


def photograph(x: float, gain: float = 1.0, passing: np.ndarray | None = None) -> PosedImage:
    """What a camera sees of the yard and its car; perhaps of a black thing that passes by."""
    pitch = exp_so3(np.array([-np.deg2rad(12), 0, 0]))
    T = make_transform(AHEAD @ pitch, np.array([x, 0.0, EYE_M]))
    row, column = (axis.ravel() for axis in np.indices((200, 400)))
    rays = unproject(column, row, np.ones(len(row)), CAMERA) @ T[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(rays[:, 2] < 0, -EYE_M / rays[:, 2], np.inf)
    solids = [(np.append(BOX[0], 0.0), np.append(BOX[1], ROOF_M), None)]
    solids += [] if passing is None else [(*passing, (5.0, 5.0, 5.0))]
    depth, plain = ground, np.full((len(rays), 3), np.nan)
    for low, high, paint in solids:
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(end - T[:3, 3]) / rays for end in (low, high)])
        near, far = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
        hit = (near < far) & (near > 0) & (near < depth)
        depth = np.where(hit, near, depth)
        plain[hit] = np.nan if paint is None else paint
    depth = np.minimum(depth, 200.0)
    seen = np.where(np.isnan(plain), colours(T[:3, 3] + depth[:, None] * rays), plain)
    image = np.clip(np.rint(gain * seen), 0, 255).astype(np.uint8).reshape(200, 400, 3)
    return PosedImage(0, image, CAMERA, T)


def cloud() -> PointCloud:
    """The yard and the roof of the car as fused points, with noise of 1 cm."""
    random = np.random.default_rng(2)
    grid = np.meshgrid(np.arange(2.05, 18, 0.1), np.arange(-3.95, 4, 0.1))
    xy = np.stack([axis.ravel() for axis in grid], axis=1)
    roof = ((xy >= BOX[0]) & (xy < BOX[1])).all(axis=1)
    xyz = np.column_stack([xy, np.where(roof, ROOF_M, 0.0)])
    rgb = np.rint(colours(xyz)).astype(np.uint8)
    xyz[:, 2] += random.normal(0, 0.01, len(xyz))
    crown = xyz[:900] + np.array([0.0, 0.0, 3.0])  # higher than the camera
    xyz, rgb = np.concatenate([xyz, crown]), np.concatenate([rgb, np.zeros((900, 3), np.uint8)])
    return PointCloud(xyz.astype(np.float32), rgb=rgb, frame="map")


class Yard:
    """What an orthophoto needs of a map."""

    resolution_m = CELL_M

    def __init__(self) -> None:
        occupancy = SimpleNamespace(max_range_m=12.0)
        fusion = SimpleNamespace(voxel_m=CELL_M, max_depth_error_m=None, doublings=0)
        self.config = SimpleNamespace(fusion=fusion, occupancy=occupancy)

    def __iter__(self):
        return iter([SimpleNamespace(key=(0, 0), cloud=cloud())])

    def bounds(self, _):
        return "all"


@pytest.fixture
def relief(tmp_path, monkeypatch):
    ground = GroundSurface(np.zeros((40, 40)), 1.0, (-20.0, -20.0), EYE_M)
    grounds = SimpleNamespace(grounds=lambda: iter([("all", ground)]))
    monkeypatch.setattr(made, "Flattening", lambda placed: grounds)
    monkeypatch.setattr(made, "place_of", lambda context, cell_m: YARD)
    monkeypatch.setattr(made, "ground_blocks", lambda *how: iter([]))
    drives = [SimpleNamespace(session=SimpleNamespace(camera=CAMERA))]
    placed = SimpleNamespace(tiles=Yard())
    return Relief(SimpleNamespace(placed=placed, T_survey_map=np.eye(4), drives=drives), tmp_path)


def painted(relief: Relief, views: list[PosedImage]) -> tuple[np.ndarray, np.ndarray]:
    """The picture, its places (R, C, 2), of which the last band is whether it was seen."""
    for view in views:
        relief.look(relief.sight(view.camera, view.T_map_camera))
    place = RasterPlace(GSD_M, 50, 100, 400, 200)
    canvas = Canvas(relief, place)
    for view in views:
        canvas.add(view)
    return canvas.block(0, 200).astype(float), place.centres(0, 0, (200, 400))


def truth(places: np.ndarray) -> np.ndarray:
    xy = places.reshape(-1, 2)
    roof = ((xy >= BOX[0]) & (xy < BOX[1])).all(axis=1)
    return colours(np.column_stack([xy, ROOF_M * roof])).reshape(*places.shape[:2], 3)


def test_marks_lie_within_a_cell_of_their_places(relief):
    picture, places = painted(relief, [photograph(x) for x in np.arange(-4.0, 10.0, 0.7)])
    true = truth(places).mean(axis=2)
    window, off = cv2.createHanningWindow((50, 50), cv2.CV_64F), []
    for row in range(0, 150, 50):
        for column in range(0, 350, 50):
            at = np.s_[row : row + 50, column : column + 50]
            if (picture[3][at] == 255).mean() > 0.99:
                pair = [np.ascontiguousarray(one[at]) for one in (picture[:3].mean(axis=0), true)]
                off.append(cv2.phaseCorrelate(*pair, window)[0])
    assert len(off) > 8
    off = np.linalg.norm(off, axis=1)
    assert np.median(off) < 0.5
    assert off.max() < 1.0
    assert np.median(np.abs(picture[0] - true)[picture[3] == 255]) < 3
    assert relief.gsd_m == float(f"{relief.gsd_m:.2g}")
    assert 0.01 < relief.gsd_m < 0.1


def test_what_no_image_sees_is_transparent_and_behind_a_car_is_no_car(relief):
    picture, places = painted(relief, [photograph(0.0)])
    x, y = places.transpose(2, 0, 1)
    seen = picture[3] == 255
    # Straight behind the car the ground is hidden: by a roof of 1.0 m, up to 8 + 5 m and more.
    line = y / x  # of sight
    behind = (x > 8.4) & (x < 12) & (line > 2.0 / 9.0) & (line < 0.25)
    assert behind.sum() > 100
    assert not seen[behind].any()
    beside = (x > 5) & (x < 10) & (np.abs(y) < 0.9)
    assert seen[beside].mean() > 0.98
    red = (picture[0] > 200) & (picture[1] < 60)  # sides of the car, seen aslant
    assert (red & seen).sum() < 40


def test_exposure_is_evened_and_what_passed_by_is_no_ghost(relief):
    thing = np.array([[9.0, -2.0, 0.0], [10.5, -0.5, 1.4]])
    # Those in the middle, which see the place best, are brighter, and have something there.
    views = [
        photograph(x, 1.3 if 3 < x < 7 else 0.8, thing if 3 < x < 7 else None)
        for x in np.arange(-4.0, 9.0, 0.7)
    ]
    picture, places = painted(relief, views)
    x, y = places.transpose(2, 0, 1)
    there = (x > 9.1) & (x < 10.4) & (y > -1.9) & (y < -0.6) & (picture[3] == 255)
    off = np.abs(picture[0] - truth(places)[..., 0])
    assert there.sum() > 500
    assert np.mean(off[there] > 40) < 0.08
    ground = (picture[3] == 255) & (np.abs(y + 2.5) < 1.0) & ~there
    assert np.median(off[ground]) < 4


def test_a_car_is_of_one_image(relief, monkeypatch):
    # The blue of each image is its number, and nothing evens that.
    def as_good(image, sight, fused, good):
        return np.ones(3), np.ones(good.shape, np.float32)

    monkeypatch.setattr(made, "_compared", as_good)
    views = []
    for number, x in enumerate(np.arange(-3.0, 2.5, 0.5)):
        view = photograph(x)
        blue = np.full((200, 400), 10 * number + 10, np.uint8)
        views.append(view._replace(image=np.dstack([view.image[..., :2], blue])))
    picture, places = painted(relief, views)
    x, y = places.transpose(2, 0, 1)
    roof = (x > 6.2) & (x < 7.8) & (y > 1.2) & (y < 2.2) & (picture[3] == 255)
    assert roof.sum() > 400
    _, counts = np.unique(picture[2][roof], return_counts=True)
    assert counts.max() > 0.9 * roof.sum()
    road = (np.abs(y) < 1) & (picture[3] == 255)
    assert len(np.unique(picture[2][road])) > 5

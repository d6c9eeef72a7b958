"""Small values shared by the tests of all reports."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from recon.core.values import (
    Disparity,
    DisparityMetrics,
    DisparityTruth,
    OccupancyGrid,
    PointCloud,
    Reason,
    RectifiedCamera,
    RectifiedPair,
    Trajectory,
    TrajectoryMetrics,
    TriangleMesh,
)
from recon.evaluation.map import DriveErrors
from recon.look.fault import NAMES, RigFault
from recon.look.fit import FittedFault
from recon.look.rig import DEPTHS, RefinedRig, RigChange
from recon.odometry.protocol import OdometryHealth
from recon.report.scene import T_UPRIGHT_CAMERA

HEIGHT_PX, WIDTH_PX = 24, 60
METRICS = TrajectoryMetrics(0.62, 0.7, 0.41, 0.01, 0.03, 10.0, 11, (5.0,), 3)


@pytest.fixture
def pair():
    left = np.random.default_rng(0).integers(0, 256, (HEIGHT_PX, WIDTH_PX), dtype=np.uint8)
    camera = RectifiedCamera(50.0, 30.0, 12.0, 30.0, 0.5, WIDTH_PX, HEIGHT_PX)
    return RectifiedPair(left, left, camera, index=7)


@pytest.fixture
def disparity():
    values = np.tile(np.linspace(1, 10, WIDTH_PX, dtype=np.float32), (HEIGHT_PX, 1))
    everything = np.ones_like(values)
    full = Disparity(values, everything, everything, np.zeros(values.shape, dtype=np.uint8))
    border = np.zeros(values.shape, dtype=bool)
    border[:, :15] = True  # a quarter
    return full.reject(border, Reason.BORDER)


@pytest.fixture
def both(disparity):
    """A disparity map whose right half is inferred."""
    reason = disparity.reason.copy()
    reason[:, WIDTH_PX // 2 :] = Reason.FILLED
    return replace(disparity, reason=reason)


@pytest.fixture
def nothing_found(disparity):
    """A disparity map without any value."""
    return disparity.reject(np.ones(disparity.values.shape, bool), Reason.LOW_TEXTURE)


@pytest.fixture
def trajectory():
    """Eleven frames, one metre each, straight ahead."""
    T = np.tile(np.eye(4), (11, 1, 1))
    T[:, 2, 3] = np.arange(11)
    return Trajectory(T, np.arange(11.0))


@pytest.fixture
def T_map_world():
    """Camera axes turned so that x is forward and z up."""
    return T_UPRIGHT_CAMERA


@pytest.fixture
def health():
    """One record per frame of `trajectory`; frame 5 has no measurement."""
    good = OdometryHealth(tracks=200, inliers=150, reprojection_px=0.2, sigma_m=0.01)
    bad = OdometryHealth(ok=False, notes=("too few <tracks>",))
    return [bad if frame == 5 else good for frame in range(11)]


@pytest.fixture
def grid():
    cells = np.full((20, 30), -1, dtype=np.int8)
    cells[5:15, 5:25] = 0
    cells[5, 5:25] = 100
    return OccupancyGrid(cells, 0.5, (-1.0, -5.0))


@pytest.fixture
def cloud():
    generator = np.random.default_rng(1)
    xyz = generator.uniform(0, 10, (2000, 3)).astype(np.float32)
    return PointCloud(xyz, rgb=generator.integers(0, 256, (2000, 3), dtype=np.uint8), frame="map")


@pytest.fixture
def mesh():
    """A flat sheet of 2 × 19 × 19 triangles."""
    vertices = np.stack(np.mgrid[:20.0, :20.0, :1.0], axis=-1).reshape(-1, 3).astype(np.float32)
    number = np.arange(400, dtype=np.int32).reshape(20, 20)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return TriangleMesh(vertices, faces, rgb=np.full((400, 3), 90, dtype=np.uint8))


@pytest.fixture
def rig(pair):
    """A right camera that is turned by half a degree: what is 30 m away seems behind infinity."""
    camera, values = pair.camera, np.zeros(len(NAMES))
    values[:4] = np.radians(0.1), np.radians(-0.5), 0.0, 0.01
    values[4] = -RigFault(camera).sigmas[4]
    covariance = np.diag((0.1 * RigFault(camera).sigmas) ** 2)
    fitted = FittedFault(values, covariance, np.zeros(len(NAMES)), 1.0, 12)
    off_px = np.linspace(-2.0, -1.0, 32).reshape(4, 8)
    off_px[0, 0] = np.nan
    changes = tuple(RigChange(10.0 * z, off_px, np.full((4, 8), 0.25)) for z in DEPTHS)
    return RefinedRig(camera, replace(camera), camera, fitted, changes, 0.05)


@pytest.fixture
def drive(request):
    """What the page of a drive is made from, with everything but loops."""
    names = ("pair", "disparity", "trajectory", "T_map_world", "health", "grid", "cloud", "mesh")
    given = SimpleNamespace(**{name: request.getfixturevalue(name) for name in names})
    session = SimpleNamespace(
        trajectory=given.trajectory,
        odometry=given.trajectory,
        T_map_world=given.T_map_world,
        health=given.health,
        camera=given.pair.camera,
        loops={},
    )
    return SimpleNamespace(
        map_=SimpleNamespace(
            first=session, joined=lambda one: np.ones(len(one.trajectory), np.bool_)
        ),
        made=given,
        errors=DriveErrors(METRICS, None, None, true_path=given.trajectory),
        sample=given,
        rig=request.getfixturevalue("rig"),
        summary={
            "source": "drives/drive <1>", "fps": 4.25, "points": 2000, "stages": {"match": 1.0},
            "nested": {"a": [1, None]}, "warnings": ["frame 5: lost"],
        },
    )  # fmt: skip


class Found(dict[str, object]):
    """Figures as the summary of a run has them."""

    to_json = dict.copy


@pytest.fixture
def view(pair, disparity, cloud):
    """A `PairResult`."""
    return SimpleNamespace(
        name="scenes/bike/im0.png",
        pair=pair,
        disparity=disparity,
        cloud=cloud,
        mesh=None,
        truth=DisparityTruth(disparity.values + 1, disparity.valid),
        metrics=DisparityMetrics({2.0: 10.0}, 25.0, 1.0, 1.0, 1440),
        by_kind={},
        summary=Found({"points": 2000, "warnings": ["a warning"]}),
        warnings=("a warning",),
    )

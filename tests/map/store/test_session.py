"""What a session of a map keeps comes back as it was, also from the map of a finished run."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from recon.core.errors import FormatError
from recon.core.geometry import se3
from recon.core.values import PointCloud, RayCloud, RayGrain, RectifiedCamera
from recon.look.fault import NAMES
from recon.look.fit import FittedFault
from recon.look.rig import RefinedRig
from recon.map.fusion import join_fused
from recon.map.map import Map
from recon.map.occupancy.part import join_occupancy
from recon.map.sessions.copying import copy_sessions, keep_map
from recon.map.sessions.joining import path_up_to
from recon.map.sessions.placed import PlacedSubmaps
from recon.map.store.map_file import MapViews
from recon.map.store.session import Session, SessionInfo
from recon.map.store.trees import Link, path_of
from recon.odometry.protocol import OdometryHealth
from recon.places.detector import StoredKeyframe
from recon.places.keyframe import Keyframe
from recon.places.places import Loop
from recon.stereo.rectify.epipolar import as_raw
from tests.map.walls import CAMERA, CONFIG, drives

GRAIN = RayGrain(0.1, 0.1 / 64, 25.0)


def _rays(seed: int, count: int) -> RayCloud:
    rng = np.random.default_rng(seed)
    return RayCloud(
        rng.integers(-(2**15), 2**15, (count, 3)).astype(np.int16),
        rng.uniform(0, 3, count).astype(np.float16),
        rng.integers(1, 256, count).astype(np.uint8),
        rng.integers(1, 256, count).astype(np.uint8),
        GRAIN.unit_m,
    )


def test_frames_come_back_bit_by_bit(tmp_path):
    path, rng = tmp_path / "map.recon", np.random.default_rng(0)
    with Map.create(path) as made:
        session = made.begin(SessionInfo("drive", "of a test", 40))
        for last in (1, 8, 8, 40):
            for number in range(len(session), last):
                pose = np.eye(4)
                pose[:3, 3] = rng.normal(size=3) * 10.0 ** rng.integers(-9, 3)
                known = {"tracks": number, "notes": ("a", "ü") if number % 5 == 0 else ()}
                health = OdometryHealth(number % 3 > 0, sigma_m=float(rng.normal()), **known)
                session.add_frame(pose, number / 7, health)
            made.commit()
            with Map.open(path) as read:
                again = read.session()
                np.testing.assert_equal(vars(again.odometry), vars(session.odometry))
                assert list(map(repr, again.health)) == list(map(repr, session.health))
                assert again.info == session.info
        assert made.store.keys("frames") == [(0, 0), (0, 1), (0, 8)]
        record = made.store.read("frames", (0, 8))
        assert record["times_s"].shape == (32,)
    with Map.open(path) as read, pytest.raises(FormatError, match=r"session \(got 2, expected 0"):
        read.session(2)
    with Map.temporary() as made, pytest.raises(FormatError, match="no frame"):
        _ = made.begin(SessionInfo()).odometry


@pytest.mark.parametrize(("measured", "length_m"), [((), 0.0), ((2,), 4.5)])
def test_a_known_path_does_not_drift(tmp_path, measured, length_m):
    with Map.create(tmp_path / "map.recon") as made:
        session = made.begin(SessionInfo())
        for frame in range(4):
            session.add_frame(
                _pose(frame), 1.0 * frame, OdometryHealth(known=frame not in measured)
            )
        made.commit()
        with Map.open(tmp_path / "map.recon") as read:
            assert path_up_to(read.session())[-1] == length_m


def test_rays_come_back_exactly():
    with Map.temporary() as made:
        session = made.begin(SessionInfo())
        session.set_axes(np.eye(4), CAMERA)
        kept = [_rays(seed, count) for seed, count in enumerate((240, 0, 1))]
        for frame, rays in enumerate(kept):
            session.add_rays(frame, rays, GRAIN)
        assert session.ray_frames == 3
        for frame, rays in enumerate(kept):
            read, grain = session.rays(frame)
            assert (grain, read.unit_m) == (GRAIN, rays.unit_m)
            np.testing.assert_equal(vars(read), vars(rays))
        nan = float("nan")
        for sizes in ((nan,) * 3, (0.1, -1.0, 25.0), (0.1, 0.0, 25.0), (30.0, 0.1, 25.0)):
            session.add_rays(0, _rays(0, 3), RayGrain(*sizes))
            with pytest.raises(FormatError, match="impossible"):
                session.rays(0)


CAMERAS = [RectifiedCamera(100.0 + n, 9.0, 5.0, 9.5, 0.5, 20, 12) for n in range(3)]
T_MAP_WORLD = [
    se3.make_transform(se3.exp_so3(np.array([0.1, 0.2 * n, 0.0])), np.array([n, 0.0, 1.0]))
    for n in range(3)
]
FRAMES = 6
KEYFRAMES = (0, 2, 5)


def _pose(frame: int) -> np.ndarray:
    return se3.make_transform(np.eye(3), np.array([0.0, 0.0, 1.5 * frame]))


def _three(lost: tuple[int, int] | None = None) -> Map:
    """Three drives with other cameras and axes; the last one has no keyframes.

    One may lose its way: number of the drive, and of the frame.
    """
    made = Map.temporary()
    blank = np.zeros((0, 3), np.float32), np.zeros((0, 32), np.uint8), np.zeros((2, 3), np.float32)
    for n in range(3):
        session = made.begin(SessionInfo(f"drive {n}"))
        session.set_axes(T_MAP_WORLD[n], CAMERAS[n])
        for frame in range(FRAMES):
            session.add_frame(_pose(frame), 0.1 * frame, OdometryHealth(ok=(n, frame) != lost))
        for frame in KEYFRAMES if n < 2 else ():
            session.keyframes.put(StoredKeyframe(Keyframe(frame, *blank), _pose(frame), 1.5))
    loop = Loop(0, 0, np.eye(4), np.eye(6), 50, 0.9)
    made.set_links([Link((0, n), loop) for n in (1, 2)], [0, 1, 2])
    return made


def test_views_are_the_keyframes_of_all_linked_drives():
    map_ = _three()
    views = MapViews(map_)
    assert [(view.session, view.keyframe.frame) for view in views] == [
        (n, frame) for n in (0, 1) for frame in KEYFRAMES
    ]
    assert [view.camera for view in views[2:4]] == CAMERAS[:2]
    assert views[1].T_world_camera == pytest.approx(_pose(2))
    T_map_camera = T_MAP_WORLD[1] @ _pose(2)
    assert T_MAP_WORLD[0] @ views[4].T_world_camera == pytest.approx(T_map_camera)
    assert [view.session for view in MapViews(map_, [1])] == [1, 1, 1]
    map_.set_links([], [1])
    assert [view.session for view in MapViews(map_)] == [1, 1, 1]
    # After loop closure they lie on the new path.
    moved = np.stack([se3.make_transform(np.eye(3), np.full(3, k)) for k in range(FRAMES)])
    map_.session(1).set_loops({"closed": [], "refused": [], "T_world_camera": moved})
    assert MapViews(map_)[1].T_world_camera == pytest.approx(moved[2])


def test_what_follows_a_lost_pose_is_not_to_be_recognised():
    map_ = _three(lost=(1, 3))
    seen = [(view.session, view.keyframe.frame) for view in MapViews(map_)]
    assert seen == [(0, 0), (0, 2), (0, 5), (1, 0), (1, 2)]
    assert [view.keyframe.frame for view in MapViews(map_, [1])] == [0, 2, 5]


BEND = se3.make_transform(se3.exp_so3(np.array([0.0, 0.02, 0.0])), np.array([0.0, 0.0, 0.31]))
VOXEL_M = CONFIG.fusion.voxel_m


def _cloud(session: Session) -> PointCloud:
    corrections = session.corrections()
    parts = [submap.fused for submap in session.submaps]
    if corrections is not None:
        parts = [part.moved(T, VOXEL_M) for part, T in zip(parts, corrections, strict=True)]
    cloud = join_fused(parts).cloud(VOXEL_M, 1)
    return cloud.select(np.lexsort(np.floor(cloud.xyz / VOXEL_M).T))


@pytest.mark.parametrize("closed", [False, True])
def test_a_finished_map_gives_cloud_and_occupancy_again(tmp_path, closed):
    with drives(1) as made:
        session = made.session()
        session.info = replace(session.info, start={"identity": {}})
        session.set_state({"odometry": None})
        if closed:
            path = session.odometry.T_world_camera
            path = np.concatenate([path[:10], BEND @ path[10:]])
            session.set_loops({"closed": [], "refused": [], "T_world_camera": path})
        keep_map(made, tmp_path / "map.recon")
        poses, cloud = session.trajectory.T_world_camera, _cloud(session)
        voxels = join_occupancy(submap.occupancy for submap in session.submaps).voxels(0.2)
    with Map.open(tmp_path / "map.recon", read_only=False) as kept:
        again = kept.session()
        assert len(again.submaps) >= 3
        assert not any(len(submap.occupancy) for submap in again.submaps)
        # What only resuming needs is left out.
        assert "state" not in kept.store.kinds()
        assert again.info.start == {}
        np.testing.assert_array_equal(again.trajectory.T_world_camera, poses)
        for name in ("xyz", "rgb", "sigma_m", "count"):
            np.testing.assert_array_equal(getattr(_cloud(again), name), getattr(cloud, name))
        cast = join_occupancy(one.occupancy for one in PlacedSubmaps(kept, CONFIG)).voxels(0.2)
        np.testing.assert_array_equal(cast.keys, voxels.keys)
        np.testing.assert_array_equal(cast.log_odds, voxels.log_odds)
        kept.store.delete("submap_entry", (0, len(again.submaps) - 1))
        kept.commit()
    with Map.open(tmp_path / "map.recon") as lacking, pytest.raises(FormatError, match="submaps"):
        PlacedSubmaps(lacking, CONFIG)


def test_the_rig_of_a_drive_is_known_to_later_ones_of_the_same_calibration(tmp_path):
    raw, count = as_raw(CAMERA), len(NAMES)
    other = replace(CAMERA, baseline_m=2.0)
    with Map.create(tmp_path / "map.recon") as made:
        for number, (given, found) in enumerate(
            [(CAMERA, other), (CAMERA, raw), (raw, raw), (other, other)]
        ):
            session = made.begin(SessionInfo(f"drive {number}"))
            session.add_frame(_pose(number), 0.0, OdometryHealth())
            session.set_axes(np.eye(4), CAMERA)
            fitted = FittedFault(
                np.arange(count) / 7, np.eye(count) / (1 + number), np.ones(count), 1.5, 12
            )
            session.set_rig(RefinedRig(given, found, CAMERA, fitted))
        session = made.begin(SessionInfo("not asked"))
        session.add_frame(_pose(7), 0.0, OdometryHealth())
        session.set_rig(RefinedRig(raw, raw, CAMERA))
        assert session.rig is None
        made.commit()
        with Map.temporary() as kept:
            copy_sessions(made, kept, without=[3])
            known = kept.known_rig(replace(CAMERA))
            assert (known.name, known.given) == ("session 1 (drive 1)", CAMERA)
            np.testing.assert_equal(asdict(known.calibration), asdict(raw))
            np.testing.assert_equal(known.fitted.covariance, np.eye(count) / 2)
            assert kept.known_rig(as_raw(CAMERA)).name == "session 2 (drive 2)"
            assert kept.known_rig(other) is None


def _poses(row: int, column: int, value: float) -> np.ndarray:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, row, column] = value
    return poses


@pytest.mark.parametrize(
    ("row", "column", "value"), [(0, 1, 0.0011), (3, 0, 1e-9), (0, 3, 1.01e5), (2, 2, -1.0)]
)
def test_a_path_with_an_impossible_pose_is_refused(row, column, value):
    with pytest.raises(FormatError, match=r"impossible pose \(got 1\)"):
        path_of(_poses(row, column, value), np.arange(3.0))


@pytest.mark.parametrize(("row", "column", "value"), [(0, 1, 0.0009), (0, 3, 0.99e5)])
def test_poses_of_few_digits_and_far_away_are_a_path(row, column, value):
    poses = _poses(row, column, value)
    np.testing.assert_array_equal(path_of(poses, np.arange(3.0)).T_world_camera, poses)

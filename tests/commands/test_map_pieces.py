"""A drive that is mapped in pieces becomes one drive: every frame once, and the same map."""

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from recon.commands import map_options
from recon.commands.config import load_config
from recon.commands.map_options import MapOptions
from recon.commands.map_pieces import LEAD, Piece, cut_drive
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import Trajectory
from recon.io.trajectory import write_kitti_poses
from recon.map.drive.drive import Workspace, session_info
from recon.map.drive.drive_odometry import odometry_of
from recon.map.drive.sequence import map_sequence
from recon.map.map import Map
from recon.map.sessions.copying import join_parts
from recon.sources.source import SourcePart
from recon.stereo.rectify.rectifier import turns_of
from recon.street.settings import StreetScene
from tests.scenery.boards import board_rig
from tests.scenery.film import film

STREET = StreetScene(
    frames=26, width_px=256, height_px=96, focal_px=150.0, seed=5, smooth_edges=False
)
PIECES = [Piece(0, 10), Piece(5, 18, 5), Piece(12, 26, 6)]


@pytest.mark.parametrize("frames", [1, 79, 80, 144, 999, 2000, 36_000])
@pytest.mark.parametrize("workers", [1, 2, 3, 64])
def test_pieces_have_every_frame_once_behind_their_leads(frames, workers):
    pieces = cut_drive(frames, workers)
    own = [n for piece in pieces for n in range(piece.first + piece.lead, piece.last)]
    assert own == list(range(frames))
    assert pieces[0].lead == 0
    assert all(piece.lead == LEAD for piece in pieces[1:])
    assert len(pieces) == 1 or len(pieces) % workers == 0 or len(pieces) == frames // (2 * LEAD)


def test_known_poses_of_the_lens_become_those_of_the_rectified_camera(tmp_path, monkeypatch):
    rig, config = board_rig(), load_config(None, ["source.poses_of=raw"])
    source = SimpleNamespace(calibration=rig)
    monkeypatch.setattr(map_options, "open_source", lambda *_: source)
    turned = [make_transform(exp_so3(n * np.ones(3)), n * np.ones(3)) for n in (0.0, 0.3)]
    raw = Trajectory(np.stack(turned), np.arange(2.0))
    write_kitti_poses(tmp_path / "poses.txt", raw)
    options = MapOptions(source=tmp_path, poses_file=tmp_path / "poses.txt")
    poses = options.open(config)[1].known_poses.T_world_camera
    turn = turns_of(rig, config.rectification).R_left
    assert np.arccos((np.trace(turn) - 1) / 2) > 0.005
    ray = np.array([0.1, 0.2, 1.0])  # of the raw camera
    np.testing.assert_allclose(
        poses[:, :3, :3] @ turn @ ray, raw.T_world_camera[:, :3, :3] @ ray, atol=1e-9
    )
    np.testing.assert_allclose(poses[:, :3, 3], raw.T_world_camera[:, :3, 3], atol=1e-9)


@pytest.mark.slow
def test_path_and_map_are_those_of_one_run():
    source = film(STREET)
    config = load_config(None, ["submaps.length_m=4", "submaps.tile_m=12.8"])

    def parts() -> Iterator[tuple[Map, int]]:
        for piece in PIECES:
            part = Workspace(threads=1)
            map_sequence(SourcePart(source, *piece), config, workspace=part)
            yield part.map, piece.lead

    work = Workspace(threads=1)
    session = work.map.begin(session_info(source, config))
    join_parts(work.map, parts(), config)
    odometry = odometry_of(config, source, None, None, None).state()
    session.set_state({"mapper": {"odometry": odometry, "builder": None}, "seconds": 1.0})
    whole = map_sequence(source, config, workspace=Workspace(threads=1))
    joined = map_sequence(source, config, workspace=work)
    np.testing.assert_array_equal(joined.trajectory.timestamps_s, whole.trajectory.timestamps_s)
    assert joined.session.submaps.frames == len(joined.health) == STREET.frames
    # The first piece is the drive itself; behind it only the odometry has begun elsewhere.
    poses = joined.trajectory.T_world_camera
    np.testing.assert_array_equal(poses[:10], whole.trajectory.T_world_camera[:10])
    apart_m = np.linalg.norm(joined.path_m - whole.path_m, axis=1)
    assert 0 < apart_m.max() < 0.01 * whole.trajectory.path_length_m
    np.testing.assert_array_equal(joined.T_map_world, whole.T_map_world)
    assert joined.loops.keyframes >= STREET.frames // 2
    # Voxels that are turned into others share some of these: fewer points for the same surface.
    assert 0.8 < len(joined.cloud) / len(whole.cloud) < 1.05
    assert len(joined.voxels) == pytest.approx(len(whole.voxels), rel=0.05)
    assert joined.camera == whole.camera
    assert joined.sample.pair.timestamp_s == whole.sample.pair.timestamp_s

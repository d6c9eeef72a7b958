"""A map as Nav2 reads it: the robot starts in free space, inside the grid, and knows its base."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from recon.commands.config import load_config, run_settings
from recon.commands.export import run_occupancy
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.geometry.se3 import invert
from recon.core.values import Trajectory
from recon.io.trajectory import read_tum
from recon.map.map import Map
from recon.sources.kitti import open_kitti
from recon.sources.source import StereoSource
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.flow.runs import summary_of

FOOTPRINT_M = 0.3
FREE, OCCUPIED, UNKNOWN = 0, 100, -1


class ServedMap:
    """A map by the documented rule of nav2_map_server's trinary mode, without our reader.

    The occupancy of a pixel is (255 - value) / 255: above occupied_thresh it is occupied, below
    free_thresh free, else unknown. `origin` is the lower left corner of the lower left pixel.
    """

    def __init__(self, run: Path) -> None:
        described = yaml.safe_load((run / "map/grid.yaml").read_text())
        assert (described["mode"], described["negate"]) == ("trinary", 0)
        assert described["origin"][2] == 0.0
        image = cv2.imread(str(run / "map" / described["image"]), cv2.IMREAD_UNCHANGED)
        occupancy = (255 - image.astype(np.float64)) / 255
        self.cells = np.full(image.shape, UNKNOWN)
        self.cells[occupancy > described["occupied_thresh"]] = OCCUPIED
        self.cells[occupancy < described["free_thresh"]] = FREE
        self._corner = np.array(described["origin"][:2])
        self._resolution = described["resolution"]

    def at(self, xy: np.ndarray) -> np.ndarray:
        """The cells of places (N, 2); fails outside of the map."""
        column, row = np.floor((xy - self._corner) / self._resolution).astype(int).T
        assert (column >= 0).all()
        assert (row < len(self.cells)).all()
        return self.cells[len(self.cells) - 1 - row, column]


def _disc(centre: np.ndarray, radius_m: float) -> np.ndarray:
    grid = np.arange(-radius_m, radius_m + 0.01, 0.05)
    xy = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    return centre + xy[np.linalg.norm(xy, axis=1) <= radius_m]


def _check_start(run: Path, least_free: float = 1.0) -> None:
    """The start and all trusted poses are free, with room for a robot around the start."""
    served, base = ServedMap(run), read_tum(run / "trajectory_map_base_tum.txt")
    with Map.open(run) as map_:
        path = base.positions_m[map_.first.trusted, :2]
    assert np.linalg.norm(path[0]) < 1e-6
    # The corners of cells that a footprint cuts are not all within it: the inner cells are free.
    assert (served.at(_disc(path[0], FOOTPRINT_M - 0.15)) == FREE).all()
    # Every footprint of up to 5 m lies inside of the map: at() fails otherwise.
    assert len(served.at(_disc(path[0], 4.9)))
    assert (served.at(path) == FREE).mean() >= least_free


def _map(source: StereoSource, out: Path, poses: Trajectory | None = None) -> None:
    config = load_config(None, ["loops.enabled=false"])
    run_map(source, config, MapOptions(audit=False, out=out, mesh=False, known_poses=poses))


def test_a_remade_map_has_the_same_start(small_demo, tmp_path):
    out = tmp_path / "out"
    wider = run_settings(small_demo, None, ["grid.vehicle_width_m=1.8"])
    summary = run_occupancy(small_demo, wider, out=out).to_json()
    # Poses come from a file with 13 digits.
    T_base_camera = summary_of(small_demo)["T_base_camera"]
    np.testing.assert_allclose(summary["T_base_camera"], T_base_camera, atol=1e-9)
    served = ServedMap(out)
    assert (served.at(_disc(np.zeros(2), 0.75)) == FREE).all()
    nothing = run_settings(small_demo, None, ["grid.vehicle_width_m=0"])
    run_occupancy(small_demo, nothing, out=tmp_path / "seen")
    assert (ServedMap(tmp_path / "seen").at(np.zeros((1, 2))) == UNKNOWN).all()


def test_a_robot_starts_in_free_space_where_the_camera_stands_on_the_road(small_demo):
    _check_start(small_demo)
    summary = summary_of(small_demo)
    # 1.65 m in the street's settings; the ground is measured to a few centimetres.
    assert summary["camera_height_m"] == pytest.approx(1.65, abs=0.06)
    T_base_camera = np.array(summary["T_base_camera"])
    assert T_base_camera[:3, 3].tolist() == [0, 0, summary["camera_height_m"]]
    base = read_tum(small_demo / "trajectory_map_base_tum.txt")
    camera = read_tum(small_demo / "trajectory_tum.txt")
    # By definition: T_map_world T_world_camera = T_map_base T_base_camera.
    expected = np.array(summary["T_map_world"]) @ camera.T_world_camera @ invert(T_base_camera)
    np.testing.assert_allclose(base.T_world_camera, expected, atol=1e-9)
    np.testing.assert_array_equal(base.timestamps_s, camera.timestamps_s)
    # The start is the map's own pose, one camera height down; it drives along x.
    np.testing.assert_allclose(base.T_world_camera[0, :3, :3], np.eye(3), atol=1e-9)
    assert base.positions_m[0, 2] == pytest.approx(-summary["camera_height_m"])
    assert base.positions_m[-1, 0] > 10


def test_a_flown_rig_frees_nothing_below_it(tmp_path):
    size = {"width_px": 256, "height_px": 160, "focal_px": 150.0}
    source = SyntheticSource(StreetScene(frames=14, path="straight", smooth_edges=False, **size))
    poses = source.world.T_street_camera.copy()
    poses[:, 2, 3] += 0.8 * np.sin(np.arange(14) / 3)
    source.world = replace(source.world, T_street_camera=poses)
    _map(source, tmp_path, source.trajectory)
    summary = summary_of(tmp_path)
    assert summary["camera_height_m"] is None
    assert "not carried at one height" in summary["warnings"][0]
    # Its base is the camera itself.
    assert np.array(summary["T_base_camera"])[:3, 3].tolist() == [0, 0, 0]
    assert (ServedMap(tmp_path).at(np.zeros((1, 2))) == UNKNOWN).all()


@pytest.mark.real
@pytest.mark.slow
def test_a_real_car_starts_in_free_space(recon_data, tmp_path):
    drive = open_kitti(recon_data / "driven" / "kitti_raw_0013")
    _map(drive, tmp_path)
    assert summary_of(tmp_path)["camera_height_m"] == pytest.approx(
        1.65, abs=0.1
    )  # KITTI's setup paper
    # Of what was seen to be occupied after the car was there, nothing is freed.
    _check_start(tmp_path, least_free=0.99)

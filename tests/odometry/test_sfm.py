"""Structure from motion of rendered pairs in no order, of a room, and of what shows nothing."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.errors import MissingDependencyError, RegistrationError, SettingsError
from recon.core.geometry.alignment import fit_points
from recon.core.geometry.se3 import invert
from recon.core.progress import showing
from recon.core.values import Disparity
from recon.map.store.records import Store
from recon.odometry.protocol import Odometry, OdometryFrame
from recon.odometry.sfm import FoundOdometry, SfmOptions, find_features, find_poses
from recon.sources.registry import open_source
from recon.stereo.rectify.rectifier import RectificationSettings
from recon.street.settings import StreetScene
from tests.flow.runs import Breaks
from tests.scenery.film import RIG, Film, film
from tests.scenery.kitti import street_drive
from tests.scenery.patience import LONG_S

pytestmark = pytest.mark.usefixtures("blank_figures")
ORDER = [5, 2, 8, 0, 7, 3, 6, 1, 4]
OPTIONS = SfmOptions(RectificationSettings(), threads=2)


@pytest.fixture(scope="module")
def street():
    return film(StreetScene(frames=9, **RIG))


@pytest.fixture(scope="module")
def photos(street):
    """The frames of a street in no order; the first and the fourth are black."""
    pairs = [street.pairs[number] for number in ORDER]
    black = np.zeros_like(pairs[0].left)
    for place in (0, 3):
        pairs.insert(place, replace(pairs[place], left=black, right=black))
    return Film(pairs, street.calibration, street.trajectory.T_world_camera[[*ORDER, 0, 0]])


@pytest.fixture(scope="module")
def found(photos):
    pytest.importorskip("pycolmap", reason="the extra sfm is not installed")
    return find_poses(photos, OPTIONS)


def test_pairs_in_no_order_get_metric_poses_and_black_ones_none(found, street):
    (model,) = found.models
    assert model.frames.tolist() == [1, 2, 4, 5, 6, 7, 8, 9, 10]
    truth = street.trajectory.T_world_camera[ORDER]
    truth = invert(truth[0]) @ truth
    np.testing.assert_allclose(model.T_world_camera, truth, atol=0.06)
    scaled = fit_points(model.T_world_camera[:, :3, 3], truth[:, :3, 3], scaled=True)
    assert scaled.scale == pytest.approx(1.0, abs=0.01)
    assert (model.sigmas > 0).all()
    assert model.sigmas[:, 0].max() < 0.06
    assert found.figures().to_json()["registered"] == 9
    assert found.warnings()[0].startswith("2 of 11 pairs could not be placed")


def test_poses_that_were_found_are_given_frame_by_frame_also_after_a_break(found, photos, tmp_path):
    odometry, resumed = FoundOdometry(found), FoundOdometry()
    assert isinstance(odometry, Odometry)
    frame = OdometryFrame(None, Disparity.from_values(np.ones((2, 2))))
    first, second = odometry.register(frame), odometry.register(frame)
    assert (first.health.ok, first.health.skipped, second.health.ok) == (False, True, True)
    assert second.T_world_camera == pytest.approx(np.eye(4))
    with Store.create(tmp_path / "map.recon") as store:
        store.put("state", 0, odometry.state())
        resumed.restore(store.read("state", 0))
    for _ in range(len(photos) - 2):
        ours, theirs = resumed.register(frame), odometry.register(frame)
        np.testing.assert_array_equal(ours.T_world_camera, theirs.T_world_camera)
        assert repr(ours.health) == repr(theirs.health)


def test_photos_become_a_map_whose_first_warning_names_what_is_missing(photos, found, tmp_path):
    config = load_config(None, ["odometry.method=sfm", "rig.refine=off"])
    run = run_map(photos, config, MapOptions(out=tmp_path / "run", mesh=False, audit=False))
    assert run.warnings[0] == found.warnings()[0]
    assert run.summary.to_json()["sfm"]["models"] == [9]
    assert (run.summary.to_json()["frames"], run.summary.to_json()["frames_not_trusted"]) == (11, 2)
    assert run.mapped.session.odometry.T_world_camera[1] == pytest.approx(np.eye(4))
    assert run.summary.to_json()["camera_height_m"] == pytest.approx(1.65, abs=0.15)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run"]


def test_of_many_pairs_those_are_matched_that_look_alike(photos, found, monkeypatch):
    for name, value in {"_ALL": 4, "_ALIKE": 8, "_NEXT": ()}.items():
        monkeypatch.setattr(f"recon.odometry.sfm.{name}", value)
    (model,) = find_poses(photos, OPTIONS).models
    assert model.frames.tolist() == found.models[0].frames.tolist()
    np.testing.assert_allclose(model.T_world_camera, found.models[0].T_world_camera, atol=0.06)


def test_a_run_that_is_resumed_does_not_look_for_poses_again(tmp_path, monkeypatch):
    pytest.importorskip("pycolmap", reason="the extra sfm is not installed")
    drive, config = street_drive(tmp_path, 6, 320), load_config(None, ["odometry.method=sfm"])
    options = MapOptions(out=tmp_path / "run", mesh=False, audit=False)
    with pytest.raises(KeyboardInterrupt, match="--resume"), showing(Breaks(0)):
        run_map(open_source(drive), config, options)
    assert not [*(tmp_path / "run").rglob("sfm-*")]
    monkeypatch.setattr("recon.map.drive.sequence.find_poses", None)
    run = run_map(open_source(drive), config, replace(options, resume=True))
    assert (
        run.summary.to_json()["sfm"]["registered"],
        run.summary.to_json()["frames_not_trusted"],
    ) == (6, 0)


def test_two_places_in_one_folder_are_two_models(street):
    pytest.importorskip("pycolmap", reason="the extra sfm is not installed")
    other = film(StreetScene(frames=5, seed=3, **RIG))
    poses = np.concatenate([one.trajectory.T_world_camera for one in (street, other)])
    both = find_poses(Film([*street.pairs, *other.pairs], street.calibration, poses), OPTIONS)
    assert [model.frames.tolist() for model in both.models] == [[*range(9)], [*range(9, 14)]]
    assert "5 pairs among themselves (frames 9-13)" in both.warnings()[0]


@pytest.mark.parametrize("count", [1, 3])
def test_what_shows_no_motion_is_refused_in_one_line(street, count):
    pytest.importorskip("pycolmap", reason="the extra sfm is not installed")
    black = np.zeros_like(street.pairs[0].left)
    dark = replace(street.pairs[0], left=black, right=black)
    pairs = [street.pairs[0]] if count == 1 else [dark] * count
    still = Film(pairs, street.calibration, street.trajectory.T_world_camera[:count])
    with pytest.raises(RegistrationError, match="film: structure from motion") as caught:
        find_poses(still, OPTIONS)
    assert "\n" not in str(caught.value)


def test_live_drives_priors_and_a_missing_package_are_refused_at_once(street, monkeypatch):
    config = load_config(None, ["odometry.method=sfm"])
    monkeypatch.setitem(sys.modules, "pycolmap", sys)
    arriving = street.taken(slice(2))
    arriving.live = True
    with pytest.raises(SettingsError, match="needs all pairs"):
        run_map(arriving, config)
    with pytest.raises(SettingsError, match="--prior"):
        run_map(street, config, MapOptions(prior=street.trajectory))
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(MissingDependencyError, match=r"recon-stereo\[sfm\]"):
        run_map(street, config)


def test_features_of_a_shrunk_image_are_where_they_are_in_the_large_one(street):
    image = np.ascontiguousarray(street.pairs[0].left[:, :, 1])
    large = np.repeat(np.repeat(image, 2, axis=0), 2, axis=1)
    places, described = find_features(image, image.size)
    shrunk, _ = find_features(large, image.size)
    np.testing.assert_allclose(shrunk[:, :2], 2 * places[:, :2], atol=1e-3)
    assert described.shape == (len(places), 128)


@pytest.mark.real
@pytest.mark.slow
def test_a_room_is_placed_to_two_centimetres(recon_data):
    pytest.importorskip("pycolmap", reason="the extra sfm is not installed")
    source = open_source(recon_data / "rooms/euroc_v1_sparse")
    model = find_poses(source, OPTIONS).models[0]
    assert len(model.frames) == len(source)
    truth = np.loadtxt(recon_data / "rooms/euroc_v1_sparse/left_camera_tum.txt")[:, 1:4]
    positions_m = model.T_world_camera[:, :3, 3]
    rigid = fit_points(positions_m, truth)
    moved = positions_m @ rigid.T_to_from[:3, :3].T + rigid.T_to_from[:3, 3]
    assert np.sqrt(np.mean(np.sum((moved - truth) ** 2, axis=1))) < 0.022


def test_a_request_to_end_the_program_still_interrupts_it():
    """COLMAP's own handler would print a stack trace and end the process at once."""
    pytest.importorskip("pycolmap", reason="the extra sfm is not installed")
    script = """
import os, signal
from recon.odometry.sfm import load_colmap
signal.signal(signal.SIGTERM, signal.default_int_handler)
load_colmap()
try:
    os.kill(os.getpid(), signal.SIGTERM)
    signal.pause()
except KeyboardInterrupt:
    print("interrupted")
"""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, check=False, timeout=LONG_S)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"interrupted\n", b"")

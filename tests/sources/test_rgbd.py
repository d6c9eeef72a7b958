"""A camera with depth: its folder is read, mapped and localised like a drive of two cameras."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.commands.map import look_first
from recon.commands.map_options import MapOptions
from recon.core.errors import CalibrationError, FormatError, ReconError, SettingsError, SourceError
from recon.core.geometry.se3 import make_transform
from recon.core.values import CameraIntrinsics, RectifiedCamera, RectifiedImage, StereoCalibration
from recon.core.values.camera import depth_from_disparity, depth_sigma
from recon.evaluation.trajectory import evaluate_trajectory
from recon.io.cameras.calibration import write_recon_calibration
from recon.io.images.image import write_image
from recon.map.drive.sequence import map_sequence
from recon.odometry.features import find_in_right
from recon.odometry.sfm import check_sfm
from recon.rig.audit import audit_source
from recon.run.run import Run
from recon.sources.listed import disparity_of
from recon.sources.registry import open_source, recognise_source
from recon.sources.settings import SourceSettings
from recon.sources.source import DerivedSource
from recon.stereo.frame import FrameReconstructor
from recon.stereo.rectify.rectifier import to_grey
from tests.sources.rgbd import LATE_S, PER_METRE, levels_of, street, write_rgbd

FRAMES = 10
WIDE = SourceSettings(focal_px=187.5, baseline_m=0.5, depth_per_metre=PER_METRE)
"""A Kinect sees no street: as a disparity its depth is as sure as that of this rig."""


class Arriving(DerivedSource):
    """Images that arrive in their own time, none of them late."""

    live = True

    def __len__(self) -> int:
        return len(self.source)

    def frames(self, start: int = 0) -> Iterator[RectifiedImage]:
        return self.source.frames(start)


@pytest.fixture(scope="module")
def source():
    return street(FRAMES, width_px=320)


@pytest.fixture(scope="module")
def drive(source, tmp_path_factory):
    return write_rgbd(source, tmp_path_factory.mktemp("rgbd") / "drive")


@pytest.fixture
def copied(drive, tmp_path):
    return Path(shutil.copytree(drive, tmp_path / "drive"))


@pytest.fixture(scope="module")
def mapped(drive):
    return map_sequence(open_source(drive, settings=WIDE), load_config())


def depths(folder: Path) -> list[Path]:
    return sorted((folder / "depth").iterdir())


def first(folder: Path, **settings) -> RectifiedImage:
    return next(open_source(folder, settings=WIDE.model_copy(update=settings)).frames())


def test_images_have_the_depth_that_is_nearest_in_time(source, drive):
    assert recognise_source(drive) == "rgbd"
    opened = open_source(drive, settings=WIDE)
    assert (len(opened), opened.stereo, opened.left_out) == (FRAMES, False, 0)
    for index, view in enumerate(opened.frames(7), start=7):
        true = source.frame(index)
        assert (view.index, view.timestamp_s) == (index, 100.0 + true.pair.timestamp_s)
        np.testing.assert_array_equal(view.left_rgb, true.pair.left)
        np.testing.assert_array_equal(view.left, to_grey(true.pair.left))
        depth_m = depth_from_disparity(view.disparity.values, view.camera)
        known = levels_of(true.depth_m) > 0
        assert 0 < known.sum() < known.size
        np.testing.assert_array_equal(view.disparity.valid, known)
        np.testing.assert_allclose(depth_m[known], true.depth_m[known], atol=0.51 / PER_METRE)
    truth = opened.truth.trajectory
    np.testing.assert_allclose(truth.positions_m, source.trajectory.positions_m, atol=1e-6)


def test_depth_varies_as_a_kinects_does_and_as_it_was_rounded():
    camera = RectifiedCamera(580.0, 3.5, 0.5, 3.5, 0.075, 8, 1)
    depth_m = np.array([[0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 8.0, 0.0]])
    fine = disparity_of(levels_of(depth_m, 5000.0), 5000.0, camera)
    sigma_m = depth_sigma(depth_m[fine.valid], fine.sigma_px[fine.valid], camera)
    # Khoshelham and Oude Elberink (2012), equation 11: 1.425e-5 Z², centimetres.
    np.testing.assert_allclose(sigma_m, 1.425e-3 * depth_m[0, :-1] ** 2, rtol=0.03)
    coarse = disparity_of(np.array([[2] * 8], np.uint16), 1.0, camera)
    rounded_m = depth_sigma(np.full(8, 2.0), coarse.sigma_px[0], camera)
    np.testing.assert_allclose(rounded_m, 12**-0.5, rtol=1e-3)


def test_a_metre_is_5000_in_depth_as_tum_has_it(source, copied):
    true = source.frame(0).depth_m
    write_image(depths(copied)[0], levels_of(true, 5000.0))
    view = next(open_source(copied, settings=SourceSettings(focal_px=187.5)).frames())
    assert view.camera.baseline_m == 0.075  # of a Kinect, where none is given
    known = view.disparity.valid
    assert 0 < known.mean() < 1
    assert true[known].max() < 2**16 / 5000
    read = depth_from_disparity(view.disparity.values, view.camera)
    np.testing.assert_allclose(read[known], true[known], atol=0.51 / 5000)


def test_the_path_is_as_near_to_the_truth_as_it_is_said_to_be(source, mapped):
    assert mapped.trusted.all()
    truth, path = source.trajectory, mapped.trajectory
    sigma_m = np.linalg.norm([one.sigma_m for one in mapped.health[1:]])
    assert sigma_m < 0.01 * truth.path_length_m
    off_m = np.linalg.norm(path.positions_m - truth.positions_m, axis=1)
    assert off_m.max() < 3 * sigma_m
    assert evaluate_trajectory(path, truth).ate_m < 0.01 * truth.path_length_m
    assert len(mapped.cloud) > 100


def test_frames_have_poses_while_they_arrive(drive, mapped):
    live = map_sequence(Arriving(open_source(drive, settings=WIDE)), load_config())
    assert live.trusted.all()
    assert not live.tracks  # nothing shows a rig
    off_m = evaluate_trajectory(live.trajectory, mapped.trajectory).ate_m
    assert off_m < 0.01 * mapped.trajectory.path_length_m


def test_what_looks_at_both_cameras_is_left_out(drive, tmp_path):
    opened, config = open_source(drive, settings=WIDE), load_config()
    options = MapOptions(prior=opened.truth.trajectory)
    with Run("map", tmp_path / "run", config) as run:
        seen = look_first(opened, config, options, run)
    assert (seen.findings, seen.rig.refined, seen.rig.baseline) == ((), False, None)
    assert len(seen.look.recorded) > 1  # which the size of the scene is measured on
    reconstructor = FrameReconstructor(opened.calibration, config)
    view, disparity = reconstructor.match_roughly(next(opened.frames()))
    assert disparity is view.disparity
    assert reconstructor.inspect(view) == ((), None)
    uv, near = np.array([[20.0, 30.0]]), np.array([4.0])
    np.testing.assert_array_equal(find_in_right(view, uv, near, np.zeros((1, 2))), [[16.0, 30.0]])


@pytest.mark.parametrize("needs_both", [check_sfm, lambda one: audit_source(one, load_config())])
def test_what_needs_both_cameras_is_refused(drive, needs_both):
    with pytest.raises(SourceError, match="needs two cameras"):
        needs_both(open_source(drive, settings=WIDE))


def test_depth_farther_in_time_than_its_own_tolerance_is_that_of_no_image(copied):
    text = (copied / "depth.txt").read_text()
    for time_offset_s, fits in ((0.019, True), (0.03, False)):
        (copied / "depth.txt").write_text(
            "\n".join(
                f"{float(line.split()[0]) - LATE_S + time_offset_s:.6f} {line.split()[1]}"
                for line in text.splitlines()[1:]
            )
        )
        if fits:
            assert len(open_source(copied, settings=WIDE)) == FRAMES
        else:
            with pytest.raises(ReconError, match=r"depth|partner"):
                open_source(copied, settings=WIDE)


def pixels(*shape: int, dtype: type = np.uint16) -> np.ndarray:
    return np.random.default_rng(0).integers(1, 9, shape, dtype)


DAMAGES = {
    "160x60": (lambda p: write_image(p, pixels(60, 160)), CalibrationError),
    "16 bits": (lambda p: write_image(p, pixels(120, 320, dtype=np.uint8)), FormatError),
    "in colour": (lambda p: write_image(p, pixels(120, 320, 3)), FormatError),
    "PNG": (lambda p: p.write_bytes(p.read_bytes()[:200]), FormatError),
    "empty": (lambda p: p.write_bytes(b""), FormatError),
}


@pytest.mark.parametrize("what", DAMAGES)
def test_damaged_depth_is_refused_by_name(copied, what):
    change, error = DAMAGES[what]
    path = depths(copied)[0]
    change(path)
    with pytest.raises(error, match=what) as caught:
        first(copied)
    assert path.name in str(caught.value)


@pytest.mark.parametrize("leave", [lambda path: None, Path.mkdir])
def test_an_image_whose_depth_is_no_file_is_left_out(copied, leave):
    path = depths(copied)[3]
    path.unlink()
    leave(path)
    opened = open_source(copied, settings=WIDE)
    assert (len(opened), opened.left_out) == (FRAMES - 1, 1)
    assert [view.timestamp_s for view in opened.frames(2)][:2] == [100.2, 100.4]


def test_no_depth_at_all_is_no_point(copied):
    for path in depths(copied):
        write_image(path, np.zeros((120, 320), np.uint16))
    view = first(copied)
    assert not view.disparity.valid.any()


def test_a_calibration_of_rectified_cameras_is_read(source, copied):
    write_recon_calibration(copied / "calibration.yaml", source.calibration)
    assert next(open_source(copied).frames()).camera == source.calibration


def test_a_calibration_of_raw_cameras_is_refused(source, copied):
    lens = CameraIntrinsics(source.calibration.matrix, np.array([0.1, 0.0, 0.0, 0.0]), 320, 120)
    rig = StereoCalibration(lens, lens, make_transform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    write_recon_calibration(copied / "calibration.yaml", rig)
    with pytest.raises(CalibrationError, match="raw cameras"):
        open_source(copied)


@pytest.mark.parametrize(
    ("settings", "error", "what"),
    [
        ({"focal_px": None, "baseline_m": None}, SourceError, "calibration is missing"),
        ({"length": (0, 5, 3.0)}, SettingsError, "scale of its own"),
        ({"left": "rgb.txt"}, SourceError, "cannot be named"),
    ],
)
def test_settings_that_do_not_fit_are_refused(drive, settings, error, what):
    with pytest.raises(error, match=what):
        open_source(drive, settings=WIDE.model_copy(update=settings))

"""Rooms seen by lenses of 120, 160 and 195 degrees: rectified views, depth, maps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.errors import CalibrationError, FormatError
from recon.core.geometry.se3 import angle_rad, exp_so3, invert, make_transform
from recon.core.values import CameraIntrinsics, RectifiedCamera, StereoCalibration
from recon.io.cameras.calibration import read_calibration
from recon.io.cameras.opencv_yaml import write_opencv_calibration
from recon.io.cameras.recon_yaml import write_recon_calibration
from recon.io.cameras.ros import write_kalibr
from recon.io.images.image import write_image
from recon.map.drive.sequence import map_sequence
from recon.sources.one_pair import read_pair_input
from recon.sources.registry import open_source
from recon.stereo.frame import FrameReconstructor
from recon.stereo.rectify.rectifier import (
    RectificationSettings,
    Rectifier,
    _check_focal,
    plan_turns,
)
from tests.stereo.rectify import rooms

# The polynomial of a lens of TUM VI.
LENS = (0.01017, -0.01082, 0.00594, -0.00166)
NONE = (0.0, 0.0, 0.0, 0.0)


def tum_vi() -> StereoCalibration:
    """The rig of TUM VI's room sequences, as published with them."""

    def camera(focal: float, cx: float, cy: float, lens: tuple[float, ...]) -> CameraIntrinsics:
        K = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]])
        return CameraIntrinsics(K, np.array(lens), 1024, 1024, "fisheye")

    T = make_transform(exp_so3(np.radians([2.7, 0, 0])), np.array([-0.101, 0.002, 0.001]))
    right = (0.01372, -0.01557, 0.00905, -0.00235)
    return StereoCalibration(
        camera(380.81, 510.29, 514.33, LENS), camera(379.28, 505.57, 510.28, right), T
    )


def test_views_of_a_lens_beyond_a_half_space_keep_the_resolution_of_its_centre() -> None:
    rectifier = Rectifier(tum_vi())
    assert rectifier.camera.focal_px == pytest.approx(380.81)
    assert rectifier.camera.field_of_view_deg == pytest.approx(106.7, abs=0.1)
    assert rectifier.valid is not None
    assert rectifier.valid.all()


@pytest.mark.parametrize("lens", [NONE, LENS])
@pytest.mark.parametrize("size", [(640, 480), (512, 512)])
@pytest.mark.parametrize("field_deg", [60, 120, 160, 195, 230])
def test_the_field_of_view_is_bounded_however_wide_the_lens(
    field_deg: float, size: tuple[int, int], lens: tuple[float, ...]
) -> None:
    rig = rooms.fisheye_rig(field_deg, size, lens, centre=(6.0, -9.0))
    rectifier = Rectifier(rig)
    # Of a lens of 60 degrees the views show nearly all; 120 degrees is the bound.
    assert 53 < rectifier.camera.field_of_view_deg < 120.5
    assert rectifier.valid is not None
    assert rectifier.valid.mean() > 0.999


@pytest.mark.parametrize("field_deg", [70.0, 100.0, 140.0])
def test_the_field_of_view_can_be_set(field_deg: float) -> None:
    settings = RectificationSettings(field_of_view_deg=field_deg)
    assert Rectifier(tum_vi(), settings).camera.field_of_view_deg == pytest.approx(field_deg)


def test_a_focal_length_out_of_all_proportion_is_never_used() -> None:
    view = RectifiedCamera(1.02e6, 511.5, 511.5, 511.5, 0.1, 1024, 1024)
    with pytest.raises(CalibrationError, match=r"out of all proportion \(got 1.02e\+06 px"):
        _check_focal(view, tum_vi().left)


WRITERS = {
    "camchain.yaml": write_kalibr,
    "fisheye.yml": write_opencv_calibration,
    "rig.yaml": write_recon_calibration,
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_of_a_fisheye_gives_the_same_views(tmp_path: Path, name: str) -> None:
    write: Callable[[Path, StereoCalibration], None] = WRITERS[name]
    write(tmp_path / name, tum_vi())
    camera = Rectifier(read_calibration(tmp_path / name, 1024, 1024)).camera
    want = Rectifier(tum_vi()).camera
    assert camera.focal_px == pytest.approx(want.focal_px, abs=1e-6)
    assert camera.baseline_m == pytest.approx(want.baseline_m, abs=1e-9)


def test_an_opencv_file_that_may_be_of_a_fisheye_must_say_so(tmp_path: Path) -> None:
    write_opencv_calibration(tmp_path / "rig.yml", tum_vi())
    text = (tmp_path / "rig.yml").read_text()
    assert "distortion_model: fisheye" in text
    (tmp_path / "rig.yml").write_text(text.replace("distortion_model: fisheye\n", ""))
    with pytest.raises(FormatError, match=r"which lens model .*'distortion_model: fisheye'"):
        read_calibration(tmp_path / "rig.yml", 1024, 1024)


def eight_bits(image: np.ndarray) -> np.ndarray:
    return np.rint(255 * image).astype(np.uint8)


def sixteen_bits(image: np.ndarray) -> np.ndarray:
    return np.rint(65535 * image).astype(np.uint16)


@pytest.mark.parametrize(
    ("field_deg", "size", "lens"),
    [(120, (256, 192), NONE), (160, (224, 224), LENS), (195, (256, 256), LENS)],
)
def test_depth_of_a_room_is_right(
    tmp_path: Path, field_deg: float, size: tuple[int, int], lens: tuple[float, ...]
) -> None:
    rig, T_room_left = rooms.fisheye_rig(field_deg, size, lens), rooms.poses(1)[0]
    paths = [tmp_path / "left.png", tmp_path / "right.png"]
    for path, image in zip(paths, rooms.photograph(rig, T_room_left), strict=True):
        write_image(path, sixteen_bits(image))
    write_kalibr(tmp_path / "camchain.yaml", rig)
    given = read_pair_input(paths[0], paths[1], tmp_path / "camchain.yaml")
    config = load_config()
    _, disparity = FrameReconstructor(given.calibration, config).match(given.pair)
    turns = plan_turns(rig, config.rectification)
    depth = rooms.true_depth(turns, T_room_left)
    true_px = turns.camera.focal_px * turns.camera.baseline_m / depth
    known = np.isfinite(depth)
    error = np.abs(disparity.values - true_px)[known & disparity.valid]
    assert disparity.valid[known].mean() > 0.8
    # Noise of half a grey level and resampling: about 0.1 px on such texture.
    assert 0 < np.median(error) < 0.2
    assert np.mean(error > 1) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("field_deg", [120, 195])
def test_a_drive_through_a_room_has_the_right_path(tmp_path: Path, field_deg: float) -> None:
    rig = rooms.fisheye_rig(field_deg, (320, 320), LENS)
    frames = 8
    drive = rooms.write_euroc_room(tmp_path, rig, frames, sixteen_bits)
    mapped = map_sequence(open_source(drive), load_config())
    assert all(record.ok for record in mapped.health)
    # The world is the rectified left camera of the first frame.
    T_raw_rectified = make_transform(plan_turns(rig, RectificationSettings()).R_left.T, np.zeros(3))
    true = [T @ T_raw_rectified for T in rooms.poses(frames)]
    for found, T in zip(mapped.trajectory.T_world_camera, true, strict=True):
        off = invert(invert(true[0]) @ T) @ found
        # One pixel at 2 m is 1 to 2 cm; averaged over hundreds of features.
        assert np.linalg.norm(off[:3, 3]) < 0.02
        assert np.degrees(angle_rad(off)) < 0.5
    assert len(mapped.cloud) > 1000


def test_sixteen_bit_images_of_a_drive_share_one_white(tmp_path: Path) -> None:
    """A camera of 12 bits; the first frame is dark, the right image darker."""
    rig = rooms.fisheye_rig(160, (32, 24))
    brightest = iter([500, 400, 2100, 1500, 4000, 3000])

    def twelve_bits(image: np.ndarray) -> np.ndarray:
        ramp = np.linspace(0, next(brightest), image.size).reshape(image.shape)
        return np.rint(ramp).astype(np.uint16)

    drive = rooms.write_euroc_room(tmp_path, rig, 3, twelve_bits)
    seen = [(int(pair.left.max()), int(pair.right.max())) for pair in open_source(drive)]
    assert seen == [(31, 25), (131, 93), (249, 187)]


def test_both_images_of_one_pair_share_one_white(tmp_path: Path) -> None:
    paths = [tmp_path / "left.png", tmp_path / "right.png"]
    for path, brightest in zip(paths, (900, 1000), strict=True):
        levels = np.linspace(0, brightest, 24 * 32).reshape(24, 32)
        write_image(path, np.rint(levels).astype(np.uint16))
    pair = read_pair_input(paths[0], paths[1], None).pair
    assert (int(pair.left.max()), int(pair.right.max())) == (224, 249)

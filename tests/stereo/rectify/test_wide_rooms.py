"""Furnished rooms, seen by lenses of 60 to 230 degrees: rectified views, depth, maps."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import yaml

from recon.commands.config import load_config
from recon.core.errors import CalibrationError, FormatError
from recon.core.geometry.se3 import angle_rad, exp_so3, invert, make_transform
from recon.core.values import CameraIntrinsics, RectifiedCamera, StereoCalibration
from recon.core.values.camera import disparity_from_depth
from recon.io.cameras.calibration import read_calibration, write_opencv_calibration
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
from recon.street.render import Stage, View, make_stage, stereo_views, take_image
from recon.street.shapes import Material, Paint, boxes, merge, quads

# The polynomial of a lens of TUM VI.
LENS = (0.01017, -0.01082, 0.00594, -0.00166)
NONE = (0.0, 0.0, 0.0, 0.0)
# Camera axes (x right, y down, z forward) in room axes (x forward, y left, z up).
R_ROOM_FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def fisheye_rig(field_deg, size, coefficients=NONE, centre=(1.5, -2.0)):
    """A rig that sees ``field_deg`` across its width, 10 cm apart, the right camera pitched 2.7°.

    The coefficients are of the left lens, the right one is a little off; ``centre`` is that of the
    principal points from the image centre.
    """
    width, height = size
    focal = width / 2 / np.radians(field_deg / 2)

    def camera(scale: float, shift: float) -> CameraIntrinsics:
        x, y = (width - 1) / 2 + centre[0] + shift, (height - 1) / 2 + centre[1] - shift
        K = np.array([[focal * scale, 0, x], [0, focal * scale, y], [0, 0, 1]])
        return CameraIntrinsics(K, np.array(coefficients) * scale, width, height, "fisheye")

    T = make_transform(exp_so3(np.radians([2.7, 0.4, -0.3])), np.array([-0.101, 0.0019, 0.0012]))
    return StereoCalibration(camera(1.0, 0.0), camera(0.996, -1.2), T)


@dataclass(frozen=True, eq=False)
class LensView(View):
    """A raw camera in a room; its rays may point backwards."""

    camera: CameraIntrinsics | None = None

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Unit rays (N, 3) in room axes, by inverting the polynomial with Newton's method."""
        K = self.camera.matrix
        ahead = np.polynomial.Polynomial(
            [0.0, 1.0, *np.ravel([(0.0, k) for k in self.camera.distortion])]
        )
        plane = (pixels - K[:2, 2]) / np.diag(K)[:2]
        radius = np.linalg.norm(plane, axis=1)
        angle = radius.copy()
        for _ in range(50):
            angle -= (ahead(angle) - radius) / ahead.deriv()(angle)
        sideways = plane * (np.sin(angle) / np.maximum(radius, 1e-12))[:, None]
        rays = np.column_stack([sideways, np.cos(angle)])
        return np.asarray(rays @ self.T_scene_camera[:3, :3].T)


@cache
def room() -> Stage:
    """A room of 8 by 6 by 3 m around the origin at eye level, furnished and open to the sky."""
    rng = np.random.default_rng(1)
    low, high = np.array([-2.5, -3.0, -1.4]), np.array([5.5, 3.0, 1.6])
    x, y, z = np.diag(high - low)
    walls = [(low, x, z), (low, y, z), (low + y, x, z), (low + x, y, z), (low, x, y)]
    soups = [
        quads(p, u, v, Paint(Material.POSTER, tuple(rng.uniform(0.3, 0.9, 3)), 10 + n))
        for n, (p, u, v) in enumerate(walls)
    ]
    for n in range(9):
        corner = rng.uniform((0.8, -2.8, -1.4), (4.5, 2.0, -1.4))
        if abs(corner[1]) < 0.9:
            corner[1] += 1.8 * np.sign(corner[1])
        paint = Paint(Material.POSTER, tuple(rng.uniform(0.2, 0.9, 3)), 40 + n)
        soups.append(boxes(corner, corner + rng.uniform(0.4, 1.2, 3), paint))
    return make_stage(merge(soups), np.array([0.2, 0.3, 0.93]), 1, threads=2)


def pose(frame: int) -> np.ndarray:
    """``T_room_left``: ahead with a slight turn, swinging sideways."""
    turn = exp_so3(np.array([0.0, 0.004 * frame, 0.0]))
    place = np.array([-1.0 + 0.05 * frame, 0.1 * np.sin(0.25 * frame), 0.0])
    return make_transform(R_ROOM_FORWARD @ turn, place)


def photograph(rig: StereoCalibration, T_room_left: np.ndarray) -> list[np.ndarray]:
    """Left and right raw image in [0, 1], float64 (H, W), with noise of half a grey level."""
    images = []
    T_room_right = T_room_left @ invert(rig.T_right_left)
    for side, (camera, T) in enumerate(((rig.left, T_room_left), (rig.right, T_room_right))):
        (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
        view = LensView(T, fx, (cx, cy), camera.width_px, camera.height_px, camera)
        light = take_image(room(), view, smooth_edges=True).mean(axis=2)
        noise = np.random.default_rng([1, side]).standard_normal(light.shape)
        # Into corners beyond 100 degrees a lens lets no light through.
        v, u = np.indices(light.shape)
        radius = np.hypot((u - cx) / fx, (v - cy) / fy)
        images.append(np.clip(light + noise / 510, 0, 1) * (radius < np.radians(100)))
    return images


def write_euroc_room(folder, rig, frames, levels):
    """A drive in EuRoC's layout, ``sensor.yaml`` as TUM VI has it; ``levels`` makes pixels."""
    for n in range(frames):
        stamp = 1_520_530_308_199_447_626 + n * 50_000_000
        for side, image in enumerate(photograph(rig, pose(n))):
            view = folder / "mav0" / f"cam{side}"
            write_image(view / "data" / f"{stamp}.png", levels(image))
            with (view / "data.csv").open("a") as lines:
                lines.write(f"{stamp},{stamp}.png\n")
    cameras = ((rig.left, np.eye(4)), (rig.right, invert(rig.T_right_left)))
    for side, (camera, T_body_camera) in enumerate(cameras):
        (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
        content = {
            "sensor_type": "camera",
            "T_BS": {"cols": 4, "rows": 4, "data": T_body_camera.ravel().tolist()},
            "resolution": [camera.width_px, camera.height_px],
            "camera_model": "pinhole",
            "intrinsics": [fx, fy, cx, cy],
            "distortion_model": "equidistant",
            "distortion_coefficients": camera.distortion.tolist(),
        }
        path = folder / "mav0" / f"cam{side}" / "sensor.yaml"
        path.write_text("#Camera\n" + yaml.safe_dump(content))
    return folder


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


@pytest.mark.parametrize("lens", [NONE, LENS])
@pytest.mark.parametrize("size", [(640, 480), (512, 512)])
@pytest.mark.parametrize("field_deg", [60, 120, 160, 195, 230])
def test_the_field_of_view_is_bounded_however_wide_the_lens(field_deg, size, lens):
    rig = fisheye_rig(field_deg, size, lens, centre=(6.0, -9.0))
    rectifier = Rectifier(rig)
    # Of a lens of 60 degrees the views show nearly all; 120 degrees is the bound.
    assert 53 < rectifier.camera.field_of_view_deg < 120.5
    assert rectifier.valid.mean() > 0.999


def test_views_of_a_lens_beyond_a_half_space_keep_the_resolution_of_its_centre():
    rectifier = Rectifier(tum_vi())
    assert rectifier.camera.focal_px == pytest.approx(380.81)
    assert rectifier.camera.field_of_view_deg == pytest.approx(106.7, abs=0.1)
    assert rectifier.valid.all()
    for field_deg in (70.0, 140.0):
        set_to = Rectifier(tum_vi(), RectificationSettings(field_of_view_deg=field_deg))
        assert set_to.camera.field_of_view_deg == pytest.approx(field_deg)
        # The centre of the image goes on looking where it did.
        ahead = [(511.5 - c.cx_px, 511.5 - c.cy_px) for c in (set_to.camera, rectifier.camera)]
        zoom = set_to.camera.focal_px / rectifier.camera.focal_px
        assert ahead[0] == pytest.approx(np.array(ahead[1]) * zoom)
    view = RectifiedCamera(1.02e6, 511.5, 511.5, 511.5, 0.1, 1024, 1024)
    with pytest.raises(CalibrationError, match=r"out of all proportion \(got 1.02e\+06 px"):
        _check_focal(view, tum_vi().left)


def test_an_opencv_file_that_may_be_of_a_fisheye_must_say_so(tmp_path):
    write_opencv_calibration(tmp_path / "rig.yml", tum_vi())
    text = (tmp_path / "rig.yml").read_text()
    assert "distortion_model: fisheye" in text
    (tmp_path / "rig.yml").write_text(text.replace("distortion_model: fisheye\n", ""))
    with pytest.raises(FormatError, match=r"which lens model .*'distortion_model: fisheye'"):
        read_calibration(tmp_path / "rig.yml", 1024, 1024)


def sixteen_bits(image: np.ndarray) -> np.ndarray:
    return np.rint(65535 * image).astype(np.uint16)


@pytest.mark.parametrize(
    ("field_deg", "size", "lens"),
    [(120, (256, 192), NONE), (160, (224, 224), LENS), (195, (256, 256), LENS)],
)
def test_depth_of_a_room_is_right(tmp_path, field_deg, size, lens):
    rig = fisheye_rig(field_deg, size, lens)
    paths = [tmp_path / "left.png", tmp_path / "right.png"]
    for path, image in zip(paths, photograph(rig, pose(0)), strict=True):
        write_image(path, sixteen_bits(image))
    write_kalibr(tmp_path / "camchain.yaml", rig)
    given, config = read_pair_input(*paths, tmp_path / "camchain.yaml"), load_config()
    _, disparity = FrameReconstructor(given.calibration, config).match(given.pair)
    turns = plan_turns(rig, config.rectification)
    T_room_view = pose(0) @ make_transform(turns.R_left.T, np.zeros(3))
    view = stereo_views(turns.camera, T_room_view)[0]
    depth_m = room().depth(view.origin, view.directions(view.pixels()))  # NaN = sky
    true_px = disparity_from_depth(depth_m, turns.camera).reshape(disparity.values.shape)
    known = np.isfinite(true_px)
    error = np.abs(disparity.values - true_px)[known & disparity.valid]
    assert disparity.valid[known].mean() > 0.8
    # Noise of half a grey level and resampling: about 0.1 px on such texture.
    assert 0 < np.median(error) < 0.2
    assert np.mean(error > 1) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("field_deg", [120, 195])
def test_a_drive_through_a_room_has_the_right_path(tmp_path, field_deg):
    rig = fisheye_rig(field_deg, (320, 320), LENS)
    frames = 8
    drive = write_euroc_room(tmp_path, rig, frames, sixteen_bits)
    mapped = map_sequence(open_source(drive), load_config())
    assert all(record.ok for record in mapped.health)
    # The world is the rectified left camera of the first frame.
    T_raw_rectified = make_transform(plan_turns(rig, RectificationSettings()).R_left.T, np.zeros(3))
    true = [T @ T_raw_rectified for T in map(pose, range(frames))]
    for found, T in zip(mapped.trajectory.T_world_camera, true, strict=True):
        off = invert(invert(true[0]) @ T) @ found
        # One pixel at 2 m is 1 to 2 cm; averaged over hundreds of features.
        assert np.linalg.norm(off[:3, 3]) < 0.02
        assert np.degrees(angle_rad(off)) < 0.5
    assert len(mapped.cloud) > 1000


def test_sixteen_bit_images_of_a_drive_or_a_pair_share_one_white(tmp_path):
    """A camera of 12 bits; the first frame is dark, the right image darker."""
    brightest = iter([500, 400, 2100, 1500, 4000, 3000, 900, 1000])

    def twelve_bits(image: np.ndarray) -> np.ndarray:
        ramp = np.linspace(0, next(brightest), image.size).reshape(image.shape)
        return np.rint(ramp).astype(np.uint16)

    drive = write_euroc_room(tmp_path, fisheye_rig(160, (32, 24)), 3, twelve_bits)
    paths = [tmp_path / "left.png", tmp_path / "right.png"]
    for path in paths:
        write_image(path, twelve_bits(np.zeros((24, 32))))
    pairs = [*open_source(drive), read_pair_input(*paths, None).pair]
    seen = [(int(pair.left.max()), int(pair.right.max())) for pair in pairs]
    assert seen == [(31, 25), (131, 93), (249, 187), (224, 249)]

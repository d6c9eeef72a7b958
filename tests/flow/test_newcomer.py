"""From two uncalibrated cameras to a metric cloud: the commands of a newcomer, in order."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.core.geometry.se3 import apply
from recon.core.values import CameraIntrinsics
from recon.core.values.board import parse_board
from recon.io.images.image import write_image
from recon.io.models.ply import read_ply
from recon.stereo.rectify.lens import rays_of
from recon.stereo.rectify.rectifier import RectificationSettings, plan_turns
from tests.hostile.refusals import run
from tests.scenery.boards import board_rig, place_boards, render_views

BOARD = "chess:9x6:25mm"
# Two walls that meet in a corner, in the left camera's axes: normal and distance.
WALLS = np.array([[0.5, 0.0, -1.0, 1.4], [-0.45, 0.1, -1.0, 1.3]])
WALLS /= np.linalg.norm(WALLS[:, :3], axis=1, keepdims=True)


def photograph(camera: CameraIntrinsics, T_left_camera: np.ndarray) -> np.ndarray:
    """uint8 (H, W), the walls through the camera's own lens."""
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px]
    rays = rays_of(camera, np.stack([u.ravel(), v.ravel()], axis=1)) @ T_left_camera[:3, :3].T
    centre = T_left_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.stack([-(centre @ n[:3] + n[3]) / (rays @ n[:3]) for n in WALLS])
    nearest = np.min(np.where(reach > 0, reach, np.inf), axis=0)
    xyz = centre + nearest[:, None] * rays
    paint = np.random.default_rng(0).uniform(20, 235, (512, 512)).astype(np.float32)
    paint = cv2.GaussianBlur(paint, (0, 0), 1.2)
    paint = cv2.normalize(paint, None, 20, 235, cv2.NORM_MINMAX)
    # 6 mm a texel, seen at about 4 mm a pixel.
    at = (np.stack([xyz[:, 0] + xyz[:, 2], xyz[:, 1]]) / 0.006 % 510).astype(np.float32)
    at = np.nan_to_num(at)  # A fisheye's corners see nothing.
    grey = cv2.remap(paint, *(each.reshape(u.shape) for each in at), cv2.INTER_LINEAR)
    return np.asarray(grey).astype(np.uint8)


def take_images(folder, rig):
    board = parse_board(BOARD)
    pairs = render_views(rig, board, place_boards(rig, board, 12, seed=4))
    poses = (np.eye(4), np.linalg.inv(rig.T_right_left))
    pairs.append((photograph(rig.left, poses[0]), photograph(rig.right, poses[1])))
    for number, pair in enumerate(pairs):
        for side, image in zip(("left", "right"), pair, strict=True):
            name = "room" if number == 12 else f"board{number:02d}"
            write_image(folder / f"{side}_{name}.png", image)


def recon(*arguments: str | Path) -> dict[str, object]:
    done = run(*arguments, "--json")
    assert done.code == 0, done.err
    return dict(json.loads(done.out))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lens", "form"), [("radtan", "recon"), ("rational", "ros"), ("fisheye", "opencv")]
)
def test_images_of_a_board_lead_to_a_cloud_in_metres(tmp_path, lens, form):
    rig = board_rig(lens, 480, 360)
    take_images(tmp_path, rig)
    recon("board", BOARD, "--out", tmp_path / "board.pdf")
    calibrated = recon(
        "calibrate", tmp_path / "left_board*.png", tmp_path / "right_board*.png", "--board", BOARD,
        "--out", tmp_path / "rig.yaml", "--format", form, "--report", tmp_path / "report",
        "--model", lens,
    )  # fmt: skip
    assert calibrated["baseline_m"] == pytest.approx(rig.baseline_m, rel=0.005)
    file = tmp_path / ("rig_left.yaml" if form == "ros" else "rig.yaml")
    recon(
        "pair", tmp_path / "left_room.png", tmp_path / "right_room.png", "--calib", file,
        "--out", tmp_path / "room", "--quiet",
    )  # fmt: skip
    xyz = read_ply(tmp_path / "room" / "clouds" / "cloud.ply").xyz
    assert len(xyz) > 20_000
    # The cloud is in rectified axes of the rig that was found: near enough to the true ones.
    turn = plan_turns(rig, RectificationSettings()).R_left
    xyz_left = apply(np.block([[turn.T, np.zeros((3, 1))], [0, 0, 0, 1]]), xyz)
    off = np.abs(xyz_left @ WALLS[:, :3].T + WALLS[:, 3])
    # 2 % of what is 1.3 m away: half of it is the rotation, which nobody sees in a cloud.
    assert np.median(off.min(axis=1)) < 0.02
    for wall in range(2):
        on = off[:, wall] < 0.08
        assert on.mean() > 0.2
        depth = np.linalg.norm(xyz_left[on], axis=1)
        rays = xyz_left[on] / depth[:, None]
        true = -WALLS[wall, 3] / (rays @ WALLS[wall, :3])
        assert np.median(depth / true) == pytest.approx(1.0, abs=0.01)

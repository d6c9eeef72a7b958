"""Geometric verification separates two views of one place from two places."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry import se3
from recon.core.geometry.projection import project
from recon.core.values import RectifiedCamera
from recon.places import verify as verify_file
from recon.places.align import Seen, refine
from recon.places.keyframe import points_of
from recon.places.verify import dense_agreement, verify
from tests.places.conftest import LAP

CAMERA = RectifiedCamera(180.0, 159.5, 59.5, 159.5, 0.54, 320, 120)


def test_the_same_place_a_lap_later_is_recognised_to_centimetres(block):
    loop = verify(block.keyframe(3), block.keyframe(LAP + 3), CAMERA).loop

    off = se3.invert(block.drive.motion(3, LAP + 3)) @ loop.T_first_last
    # Disparities are off by 0.25 px, 5 cm at 7 m; over a hundred matches share that.
    assert np.linalg.norm(off[:3, 3]) < 0.1
    assert np.degrees(se3.angle_rad(off)) < 0.3
    assert loop.inliers > 50
    assert loop.dense_share > 0.9


def test_another_street_is_refused(block):
    verdict = verify(block.keyframe(3), block.keyframe(60), CAMERA)

    assert verdict.loop is None
    assert verdict.refused


def test_the_information_of_a_loop_is_that_of_its_errors(block):
    """Off by at most four standard deviations in each direction."""
    for k in (2, 4, 6):
        loop = verify(block.keyframe(k), block.keyframe(LAP + k), CAMERA).loop
        off = se3.invert(block.drive.motion(k, LAP + k)) @ loop.T_first_last
        step = np.concatenate([off[:3, 3], se3.log_so3(off[:3, :3])])
        sigma = np.sqrt(np.diag(np.linalg.inv(loop.information)))
        assert (np.abs(step) < 4 * sigma).all()


def test_surfaces_confirm_the_right_pose(block):
    first, last = block.keyframe(3), block.keyframe(LAP + 3)

    T = block.drive.motion(3, LAP + 3)
    assert dense_agreement(first, last, T, CAMERA, CAMERA) > 0.9


@pytest.mark.parametrize("offset_m", [(3.0, 0.0, 0.0), (-3.0, 0.0, 0.0), (0.0, -0.5, 0.0)])
def test_surfaces_contradict_a_wrong_pose(block, offset_m):
    """Ground and walls of a street go on for long, so that it takes some metres."""
    first, last = block.keyframe(3), block.keyframe(LAP + 3)
    T = block.drive.motion(3, LAP + 3) @ se3.make_transform(np.eye(3), np.array(offset_m))

    assert dense_agreement(first, last, T, CAMERA, CAMERA) < 0.85


def test_surfaces_of_another_street_contradict(block):
    share = dense_agreement(block.keyframe(3), block.keyframe(60), np.eye(4), CAMERA, CAMERA)

    assert share < verify_file._MIN_DENSE_SHARE


def test_matches_in_one_corner_prove_nothing(block, monkeypatch):
    first, last = block.keyframe(3), block.keyframe(LAP + 3)
    monkeypatch.setattr(verify_file, "_SPREAD_CELLS", 16)

    assert verify(first, last, CAMERA).refused == "inliers in one corner"


@pytest.mark.parametrize("seed", range(5))
def test_refinement_finds_the_motion_of_exact_points(seed):
    rng = np.random.default_rng(seed)
    T = se3.make_transform(se3.exp_so3(rng.normal(0, 0.05, 3)), rng.normal(0, 0.5, 3))
    last_xyz = rng.uniform([-4, -1.5, 6], [4, 1.5, 25], (80, 3))
    first_xyz = se3.apply(T, last_xyz)
    first, last = (
        Seen(np.column_stack(project(xyz, CAMERA)), xyz, CAMERA) for xyz in (first_xyz, last_xyz)
    )
    start = T @ se3.make_transform(se3.exp_so3(rng.normal(0, 0.01, 3)), rng.normal(0, 0.2, 3))

    aligned = refine(first, last, start)

    assert np.allclose(aligned.T_first_last, T, atol=1e-6)
    assert aligned.agree.all()


def test_points_of_pixels_project_back_onto_them():
    uvd = np.array([[10.0, 20.0, 5.0], [300.0, 100.0, 30.0]])

    assert np.column_stack(project(points_of(uvd, CAMERA), CAMERA)) == pytest.approx(uvd, rel=1e-5)

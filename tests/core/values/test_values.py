from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError, fields, replace
from typing import Any

import numpy as np
import pytest

from recon.core.errors import CalibrationError, ShapeError
from recon.core.values import (
    CameraIntrinsics,
    Disparity,
    DisparityTruth,
    OccupancyGrid,
    OccupancyVoxels,
    PointCloud,
    Reason,
    RectifiedCamera,
    RectifiedPair,
    StereoCalibration,
    StereoPair,
    Trajectory,
)
from recon.core.values.arrays import frozen_array

NAN = float("nan")
CAMERA = RectifiedCamera(700.0, 3.0, 2.0, 5.0, 0.5, 6, 4, ndisp=33)


def intrinsics(**change: Any) -> CameraIntrinsics:
    values = {"matrix": np.diag([500.0, 500, 1]), "distortion": np.zeros(5)}
    return CameraIntrinsics(**{**values, "width_px": 6, "height_px": 4, **change})


def calibration(**change: Any) -> StereoCalibration:
    T = np.eye(4)
    T[0, 3] = -0.5
    values = {"left": intrinsics(), "right": intrinsics(), "T_right_left": T}
    return StereoCalibration(**{**values, **change})


def stereo_pair(**change: Any) -> StereoPair:
    grey = np.zeros((4, 6), np.uint8)
    return StereoPair(**{"left": grey, "right": grey, **change})


def rectified_pair(**change: Any) -> RectifiedPair:
    grey = np.zeros((4, 6), np.uint8)
    return RectifiedPair(**{"left": grey, "right": grey, "camera": CAMERA, **change})


def disparity(**change: Any) -> Disparity:
    values = np.array([[1.0, NAN], [2.0, 3.0]], np.float32)
    parts = {
        "values": values,
        "confidence": np.where(np.isnan(values), 0, 1).astype(np.float32),
        "sigma_px": np.where(np.isnan(values), NAN, 0.5).astype(np.float32),
        "reason": np.where(np.isnan(values), Reason.BORDER, Reason.VALID).astype(np.uint8),
    }
    return Disparity(**{**parts, **change})


def truth(**change: Any) -> DisparityTruth:
    parts = {"values": np.ones((2, 2), np.float32), "nonocc": np.ones((2, 2), bool)}
    return DisparityTruth(**{**parts, **change})


def cloud(**change: Any) -> PointCloud:
    parts = {
        "xyz": np.arange(12, dtype=np.float32).reshape(4, 3),
        "rgb": np.zeros((4, 3), np.uint8),
        "normals": np.zeros((4, 3), np.float32),
        "sigma_m": np.arange(4, dtype=np.float32),
        "confidence": np.ones(4, np.float32),
        "weight": np.ones(4, np.float32),
        "count": np.arange(4, dtype=np.int32),
    }
    return PointCloud(**{**parts, **change})


def trajectory(**change: Any) -> Trajectory:
    poses = np.stack([np.eye(4)] * 3)
    poses[1, 0, 3], poses[2, :2, 3] = 3.0, [3.0, 4.0]
    return Trajectory(**{"T_world_camera": poses, "timestamps_s": np.arange(3.0), **change})


def voxels(**change: Any) -> OccupancyVoxels:
    parts = {"keys": np.array([[0, -1, 2]], np.int32), "log_odds": np.ones(1, np.float32)}
    return OccupancyVoxels(**{**parts, "resolution_m": 0.2, **change})


def grid(**change: Any) -> OccupancyGrid:
    parts = {"cells": np.zeros((2, 3), np.int8), "resolution_m": 0.2, "origin_m": (0.0, 0.0)}
    return OccupancyGrid(**{**parts, **change})


MAKERS: list[Callable[..., Any]] = [
    intrinsics, calibration, stereo_pair, rectified_pair, disparity, truth, cloud, trajectory,
    voxels, grid,
]  # fmt: skip


@pytest.mark.parametrize("make", MAKERS)
def test_a_value_cannot_be_changed_nor_its_arrays(make: Callable[..., Any]) -> None:
    value = make()
    for field in fields(value):
        content = getattr(value, field.name)
        with pytest.raises(FrozenInstanceError):
            setattr(value, field.name, content)
        if isinstance(content, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                content.flat[0] = 1


@pytest.mark.parametrize("make", MAKERS)
def test_an_array_of_another_dtype_shape_or_kind_is_named(make: Callable[..., Any]) -> None:
    value = make()
    for field in fields(value):
        content = getattr(value, field.name)
        if not isinstance(content, np.ndarray):
            continue
        for wrong in (content.astype(np.complex64), content[..., None], content.tolist()):
            with pytest.raises(ShapeError, match=rf"{type(value).__name__}\.{field.name} "):
                make(**{field.name: wrong})


def test_freezing_copies_nothing_and_leaves_the_callers_array_writeable() -> None:
    mine = np.zeros(3)
    view = frozen_array("mine", mine, np.float64, (3,))
    mine[0] = 5
    assert view[0] == 5


def test_the_error_tells_got_and_expected() -> None:
    with pytest.raises(ShapeError, match=r"\(got float64 \(2, 2\), expected float32 \(N, 3\)\)"):
        PointCloud(xyz=np.zeros((2, 2)))


def test_fields_of_one_value_must_agree_in_length() -> None:
    with pytest.raises(ShapeError, match=r"PointCloud\.rgb .*expected uint8 \(4, 3\)"):
        cloud(rgb=np.zeros((3, 3), np.uint8))
    with pytest.raises(ShapeError, match=r"Trajectory\.timestamps_s"):
        trajectory(timestamps_s=np.arange(2.0))
    with pytest.raises(ShapeError, match=r"RectifiedPair\.right"):
        rectified_pair(right=np.zeros((4, 5), np.uint8))
    with pytest.raises(ShapeError, match=r"left and right image differ .*left 6x4, right 5x4"):
        stereo_pair(right=np.zeros((4, 5), np.uint8))


@pytest.mark.parametrize(
    ("make", "change", "message"),
    [
        (intrinsics, {"matrix": np.full((3, 3), NAN)}, "not finite"),
        (intrinsics, {"matrix": -np.eye(3)}, "focal length is not positive"),
        (calibration, {"T_right_left": np.eye(4)}, "baseline is zero"),
        (calibration, {"T_right_left": np.diag([2.0, 1, 1, 1])}, "not orthonormal"),
        (calibration, {"T_right_left": np.full((4, 4), NAN)}, "not finite"),
    ],
)
def test_cameras_without_metric_depth_are_refused(
    make: Callable[..., Any], change: dict[str, Any], message: str
) -> None:
    with pytest.raises(CalibrationError, match=message):
        make(**change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"focal_px": 0.0}, "focal length is not positive"),
        ({"baseline_m": 0.0}, "baseline is zero"),
        ({"baseline_m": -0.5}, "baseline is negative.*swapped"),
        ({"cx_px": NAN}, "not finite"),
        ({"width_px": 0}, "image size is empty"),
    ],
)
def test_rectified_cameras_without_metric_depth_are_refused(
    change: dict[str, Any], message: str
) -> None:
    with pytest.raises(CalibrationError, match=message):
        replace(CAMERA, **change)


def test_doffs_is_the_right_principal_point_minus_the_left() -> None:
    assert CAMERA.doffs_px == 2
    np.testing.assert_array_equal(CAMERA.matrix, [[700, 0, 3], [0, 700, 2], [0, 0, 1]])


def test_a_resized_camera_sees_the_same_directions() -> None:
    half = CAMERA.resized(3, 2)
    # Edges of the image, at -0.5 and width - 0.5, stay at the same angle.
    for camera in (CAMERA, half):
        edges = (np.array([-0.5, camera.width_px - 0.5]) - camera.cx_px) / camera.focal_px
        np.testing.assert_allclose(edges, [-3.5 / 700, 2.5 / 700], rtol=1e-12)
    assert (half.doffs_px, half.baseline_m, half.ndisp) == (1, 0.5, 17)
    assert half.resized(6, 4).focal_px == CAMERA.focal_px


def test_colours_of_a_grey_pair_are_its_grey_thrice() -> None:
    grey = np.arange(24, dtype=np.uint8).reshape(4, 6)
    np.testing.assert_array_equal(rectified_pair(left=grey).colours[:, :, 1], grey)
    rgb = np.zeros((4, 6, 3), np.uint8)
    np.testing.assert_array_equal(rectified_pair(left_rgb=rgb).colours, rgb)


def test_a_disparity_is_valid_exactly_where_its_reason_says_so() -> None:
    with pytest.raises(ShapeError, match=r"Disparity\.reason is VALID where values is NaN"):
        disparity(reason=np.zeros((2, 2), np.uint8))


def test_rejecting_pixels_gives_the_reason_to_those_alone_that_had_a_value() -> None:
    rejected = disparity().reject(np.array([[True, True], [False, False]]), Reason.EDGE)
    assert rejected.valid.tolist() == [[False, False], [True, True]]
    assert rejected.reason.tolist() == [[Reason.EDGE, Reason.BORDER], [0, 0]]
    assert rejected.confidence.tolist() == [[0, 0], [1, 1]]
    assert np.isnan(rejected.sigma_px[0]).all()
    assert disparity().valid.tolist() == [[True, False], [True, True]]


def test_selecting_points_selects_every_field() -> None:
    chosen = cloud(frame="world").select(np.array([False, True, False, True]))
    assert len(chosen) == 2
    assert chosen.xyz[:, 0].tolist() == [3, 9]
    assert chosen.sigma_m is not None
    assert chosen.sigma_m.tolist() == [1, 3]
    assert chosen.frame == "world"
    assert PointCloud(cloud().xyz).select(np.array([2, 0])).xyz[:, 0].tolist() == [6, 0]


def test_path_length_adds_the_steps() -> None:
    assert trajectory().distances_m.tolist() == [0, 3, 7]
    assert trajectory().path_length_m == 7
    empty = Trajectory(np.zeros((0, 4, 4)), np.zeros(0))
    assert (len(empty), empty.path_length_m) == (0, 0)


def test_a_pose_that_is_not_finite_is_named_by_its_number() -> None:
    poses = np.stack([np.eye(4)] * 3)
    poses[1, 0, 3] = NAN
    with pytest.raises(ShapeError, match="pose 1 is not finite"):
        trajectory(T_world_camera=poses)


def test_a_voxel_spans_from_its_key_to_the_next() -> None:
    np.testing.assert_allclose(voxels().centres_m, [[0.1, -0.1, 0.5]], atol=1e-12)

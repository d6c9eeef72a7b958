from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError, fields, replace
from typing import Any

import numpy as np
import pytest

import recon
from recon.core.errors import CalibrationError, ShapeError
from recon.core.values import (
    CameraIntrinsics,
    Disparity,
    DisparityTruth,
    OccupancyGrid,
    OccupancyVoxels,
    PointCloud,
    RayCloud,
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


def rectified(**change: Any) -> RectifiedCamera:
    return replace(CAMERA, **change)


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
        (intrinsics, {"matrix": np.diag([500.0, 500, 2])}, "none of a lens"),
        (intrinsics, {"distortion": np.full(5, 2e6)}, "distortion is implausible"),
        (intrinsics, {"distortion": np.zeros(5), "model": "fisheye"}, "four distortion .*got 5"),
        (rectified, {"focal_px": 0.0}, "focal length is not positive"),
        (rectified, {"focal_px": 0.03}, "focal length is implausible"),
        (rectified, {"focal_px": 6001.0}, "focal length is implausible"),
        (rectified, {"baseline_m": 0.0}, "baseline is zero"),
        (rectified, {"baseline_m": -0.5}, "baseline is negative.*swapped"),
        (rectified, {"baseline_m": 1e5}, "baseline is implausible"),
        (rectified, {"cx_px": NAN}, "not finite"),
        (rectified, {"cx_px": -700.0}, "principal point is far outside"),
        (rectified, {"cx_right_px": 700.0}, "principal point is far outside"),
        (rectified, {"width_px": 0}, "image size is empty"),
        (rectified, {"height_px": 2_000_000}, "image size is implausible"),
    ],
)
def test_cameras_without_metric_depth_are_refused(
    make: Callable[..., Any], change: dict[str, Any], message: str
) -> None:
    with pytest.raises(CalibrationError, match=message):
        make(**change)


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


GIVEN = np.array([[5.0, np.nan, np.inf], [0.0, -3.0, 7.5]])


def test_a_disparity_is_made_of_values_alone() -> None:
    made = Disparity.from_values(GIVEN)
    assert made.values.dtype == np.float32
    assert made.valid.tolist() == [[True, False, False], [False, False, True]]
    assert made.values[made.valid].tolist() == [5, 7.5]
    assert made.confidence.tolist() == np.float32([[0.9, 0, 0], [0, 0, 0.9]]).tolist()
    assert set(made.sigma_px[made.valid].tolist()) == {0.25}
    assert np.isnan(made.sigma_px[~made.valid]).all()
    assert set(made.reason[~made.valid].tolist()) == {Reason.AMBIGUOUS}


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.uint8, np.int64])
def test_any_dtype_of_real_numbers_is_taken(dtype: type) -> None:
    made = Disparity.from_values(np.array([[0, 4], [6, 8]], dtype))
    assert made.values[made.valid].tolist() == [4, 6, 8]


def test_lists_and_masked_arrays_are_taken() -> None:
    assert Disparity.from_values([[1, 2], [3, 4]]).valid.all()
    masked = np.ma.masked_greater(np.arange(1.0, 7.0).reshape(2, 3), 4)
    assert Disparity.from_values(masked).valid.sum() == 4


def test_confidence_and_sigma_may_be_given_and_are_read_where_there_is_a_match() -> None:
    sure = np.where(np.isfinite(GIVEN), 0.5, np.nan)
    made = Disparity.from_values(GIVEN, confidence=sure, sigma_px=1)
    assert made.confidence[made.valid].tolist() == [0.5, 0.5]
    assert made.sigma_px[made.valid].tolist() == [1, 1]


@pytest.mark.parametrize(
    ("values", "others", "words"),
    [
        (np.ones((2, 2, 1)), {}, "wrong shape"),
        (np.ones((0, 3)), {}, "wrong shape"),
        ("five", {}, "not an array of real numbers"),
        (np.ones((2, 2), bool), {}, "not an array of real numbers.*bool"),
        (np.ones((2, 2), complex), {}, "not an array of real numbers.*complex"),
        ([[1, 2], [3]], {}, "not an array"),
        (GIVEN, {"confidence": 1.5}, "confidence"),
        (GIVEN, {"confidence": np.nan}, "confidence"),
        (GIVEN, {"confidence": np.ones((3, 2))}, "confidence has the wrong shape"),
        (GIVEN, {"sigma_px": 0}, "sigma_px"),
        (GIVEN, {"sigma_px": np.inf}, "sigma_px"),
    ],
)
def test_what_cannot_be_a_disparity_is_refused(
    values: object, others: dict[str, object], words: str
) -> None:
    with pytest.raises(ShapeError, match=words):
        Disparity.from_values(values, **others)  # type: ignore[arg-type]


def test_a_truth_is_made_of_values_and_a_mask_of_middlebury() -> None:
    levels = np.array([[255, 255, 255], [255, 255, 128]], np.uint8)
    made = DisparityTruth.from_values(GIVEN, levels)
    assert np.isfinite(made.values).tolist() == [[True, False, False], [False, False, True]]
    assert made.nonocc.tolist() == [[True, False, False], [False, False, False]]
    assert DisparityTruth.from_values(GIVEN, levels == 255).nonocc.sum() == 1
    assert DisparityTruth.from_values(GIVEN).nonocc.sum() == 2


@pytest.mark.parametrize("mask", [np.ones((2, 3), np.uint8), np.ones((3, 2), bool), 255])
def test_a_mask_that_is_none_is_refused(mask: object) -> None:
    with pytest.raises(ShapeError, match="no mask of the truth"):
        DisparityTruth.from_values(GIVEN, mask)  # type: ignore[arg-type]


ZEROS = np.zeros((500, 3), np.float32)
POSES = np.tile(np.eye(4), (40, 1, 1))
POSES[:, 2, 3] = np.arange(40) / 2
TRAJECTORY = recon.Trajectory(POSES, np.arange(40) / 10)
CELLS = np.full((30, 20), -1, np.int8)
CELLS[:3], CELLS[3:6] = 0, 100
SHARES = np.zeros(500, np.float16), np.zeros(500, np.uint8), np.zeros(500, np.uint8)
SHOWN = {
    recon.Disparity.from_values([[1, 2], [0, 5]]): "Disparity(2x2, 1 to 5 px, 75.0 % valid)",
    recon.Disparity.from_values([[0, 0]]): "Disparity(2x1, 0 % valid)",
    recon.DisparityTruth.from_values([[1, 2.5, np.inf, 0]], [[True, False, True, True]]): (
        "DisparityTruth(4x1, 1 to 2.5 px, 50.0 % known, 25.0 % not occluded)"
    ),
    stereo_pair(name="im0.png", index=3): "StereoPair('im0.png', 6x4 grey, frame 3)",
    rectified_pair(): "RectifiedPair(grey, frame 0, RectifiedCamera(focal_px=700.0, cx_px=3.0, "
    "cy_px=2.0, cx_right_px=5.0, baseline_m=0.5, width_px=6, height_px=4, ndisp=33))",
    calibration(): "StereoCalibration(baseline 0.5 m, "
    + ", ".join(
        2
        * ["CameraIntrinsics(6x4, fx 500, fy 500, cx 0, cy 0 px, pinhole [0, 0, 0, 0, 0])"]
    )
    + ")",
    recon.PointCloud(ZEROS, rgb=ZEROS.astype(np.uint8)): (
        "PointCloud(500 points, x 0 to 0, y 0 to 0, z 0 to 0 m, camera axes, rgb)"
    ),
    recon.PointCloud(ZEROS[:0]): "PointCloud(0 points, empty, camera axes)",
    TRAJECTORY: "Trajectory(40 poses, 19.5 m, 3.9 s)",
    replace(TRAJECTORY, T_world_camera=POSES[:0], timestamps_s=np.zeros(0)): (
        "Trajectory(0 poses, 0 m, 0 s)"
    ),
    recon.OccupancyVoxels(ZEROS.astype(np.int32), ZEROS[:, 0] + 1, 0.2): (
        "OccupancyVoxels(500 voxels of 0.2 m, 500 occupied)"
    ),
    recon.OccupancyGrid(CELLS, 0.1, (-1.0, 2.0)): (
        "OccupancyGrid(20x30 cells of 0.1 m, 10.0 % occupied, 10.0 % free, origin (-1.0, 2.0) m)"
    ),
    recon.TriangleMesh(ZEROS, ZEROS.astype(np.int32)): (
        "TriangleMesh(500 faces, 500 vertices, x 0 to 0, y 0 to 0, z 0 to 0 m)"
    ),
    RayCloud(ZEROS.astype(np.int16), *SHARES, 0.01): "RayCloud(500 rays)",
}  # fmt: skip


@pytest.mark.parametrize("value", SHOWN, ids=lambda value: type(value).__name__)
def test_a_value_is_shown_in_one_line(value: object) -> None:
    assert repr(value) == SHOWN[value]


def test_settings_show_what_differs_from_the_defaults() -> None:
    assert repr(recon.load_config()) == "ReconConfig()"
    config = recon.load_config(overrides=["matching.matcher=sgm", "matching.sad.window_px=7"])
    assert repr(config) == (
        "ReconConfig(matching=MatchingSettings(matcher='sgm', sad=SadSettings(window_px=7)))"
    )


def test_results_of_a_pair_show_their_parts() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (40, 80), dtype=np.uint8)
    camera = replace(CAMERA, width_px=80, height_px=40, ndisp=16)
    settings = recon.load_config(overrides=["matching.matcher=opencv-bm"])
    frame = recon.reconstruct(noise[:, :80], noise[:, :80], camera, settings)
    assert "\n" not in repr(frame)
    assert len(repr(frame)) < 500

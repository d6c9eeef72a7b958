"""Values are checked when they are made, cannot be changed, and show themselves in one line."""

from dataclasses import FrozenInstanceError, fields, replace

import numpy as np
import pytest

import recon
from recon.core.errors import CalibrationError, SettingsError, ShapeError
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
from recon.core.values.board import CalibrationBoard, parse_board

pytestmark = pytest.mark.portable

NAN = float("nan")
CAMERA = RectifiedCamera(700.0, 3.0, 2.0, 5.0, 0.5, 6, 4, ndisp=33)
GREY = np.zeros((4, 6), np.uint8)
LENS = CameraIntrinsics(np.diag([500.0, 500, 1]), np.zeros(5), 6, 4)
T_RIGHT_LEFT = np.eye(4)
T_RIGHT_LEFT[0, 3] = -0.5
FOUND = np.array([[1.0, NAN], [2.0, 3.0]], np.float32)
POSES = np.stack([np.eye(4)] * 3)
POSES[1, 0, 3], POSES[2, :2, 3] = 3.0, [3.0, 4.0]
DISPARITY = Disparity(
    FOUND,
    confidence=np.where(np.isnan(FOUND), 0, 1).astype(np.float32),
    sigma_px=np.where(np.isnan(FOUND), NAN, 0.5).astype(np.float32),
    reason=np.where(np.isnan(FOUND), Reason.BORDER, Reason.VALID).astype(np.uint8),
)
BOTH = replace(
    DISPARITY,
    reason=np.array([[Reason.VALID, Reason.BORDER], [Reason.FILLED] * 2], np.uint8),
)
CLOUD = PointCloud(
    np.arange(12, dtype=np.float32).reshape(4, 3),
    rgb=np.zeros((4, 3), np.uint8),
    normals=np.zeros((4, 3), np.float32),
    sigma_m=np.arange(4, dtype=np.float32),
    confidence=np.ones(4, np.float32),
    weight=np.ones(4, np.float32),
    count=np.arange(4, dtype=np.int32),
)
RIG, PAIR = StereoCalibration(LENS, LENS, T_RIGHT_LEFT), RectifiedPair(GREY, GREY, CAMERA)
PATH = Trajectory(POSES, np.arange(3.0))
VOXELS = OccupancyVoxels(np.array([[0, -1, 2]], np.int32), np.ones(1, np.float32), 0.2)
GRID = OccupancyGrid(np.zeros((2, 3), np.int8), 0.2, (0.0, 0.0))
TRUTH = DisparityTruth(np.ones((2, 2), np.float32), np.ones((2, 2), bool))


@pytest.mark.parametrize(
    "value",
    [LENS, RIG, StereoPair(GREY, GREY), PAIR, DISPARITY, TRUTH, CLOUD, PATH, VOXELS, GRID],
    ids=lambda value: type(value).__name__,
)
def test_a_value_and_its_arrays_cannot_be_changed_and_others_are_named(value):
    for field in fields(value):
        content = getattr(value, field.name)
        with pytest.raises(FrozenInstanceError):
            setattr(value, field.name, content)
        if isinstance(content, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                content.flat[0] = 1
            for wrong in (content.astype(np.complex64), content[..., None], content.tolist()):
                with pytest.raises(ShapeError, match=rf"{type(value).__name__}\.{field.name} "):
                    replace(value, **{field.name: wrong})


def test_freezing_copies_nothing_and_leaves_the_callers_array_writeable():
    mine = np.zeros(3)
    view = frozen_array("mine", mine, np.float64, (3,))
    mine[0] = 5
    assert view[0] == 5


@pytest.mark.parametrize(
    ("value", "change", "words"),
    [
        (CLOUD, {"rgb": np.zeros((3, 3), np.uint8)}, r"PointCloud\.rgb .*expected uint8 \(4, 3\)"),
        (CLOUD, {"xyz": np.zeros((2, 2))}, r"\(got float64 \(2, 2\), expected float32 \(N, 3\)\)"),
        (PATH, {"timestamps_s": np.arange(2.0)}, r"Trajectory\.timestamps_s"),
        (PAIR, {"right": GREY[:, :5]}, r"RectifiedPair\.right"),
        (StereoPair(GREY, GREY), {"right": GREY[:, :5]}, "differ .*left 6x4, right 5x4"),
        (DISPARITY, {"reason": np.zeros((2, 2), np.uint8)}, "VALID where values is NaN"),
        (PATH, {"T_world_camera": POSES * [[[1]], [[NAN]], [[1]]]}, "pose 1 is not finite"),
        (LENS, {"matrix": np.full((3, 3), NAN)}, "not finite"),
        (LENS, {"matrix": -np.eye(3)}, "focal length is not positive"),
        (LENS, {"matrix": np.diag([500.0, 500, 2])}, "not that of a lens"),
        (LENS, {"distortion": np.full(5, 2e6)}, "distortion is implausible"),
        (LENS, {"model": "fisheye"}, "other coefficients .*got 5"),
        (RIG, {"T_right_left": np.eye(4)}, "baseline is zero"),
        (RIG, {"T_right_left": np.diag([2.0, 1, 1, 1])}, "R of the right camera is not a rotation"),
        (RIG, {"T_right_left": np.full((4, 4), NAN)}, "not finite"),
        (CAMERA, {"focal_px": 0.0}, "focal length is not positive"),
        (CAMERA, {"focal_px": 0.03}, "focal length is implausible"),
        (CAMERA, {"focal_px": 6001.0}, "focal length is implausible"),
        (CAMERA, {"baseline_m": 0.0}, "baseline is zero"),
        (CAMERA, {"baseline_m": -0.5}, "baseline is negative.*swapped"),
        (CAMERA, {"baseline_m": 1e5}, "baseline is implausible"),
        (CAMERA, {"cx_px": NAN}, "not finite"),
        (CAMERA, {"cx_px": -700.0}, "principal point is far outside"),
        (CAMERA, {"cx_right_px": 700.0}, "principal point is far outside"),
        (CAMERA, {"width_px": 0}, "image size is empty"),
        (CAMERA, {"height_px": 2_000_000}, "image size is implausible"),
    ],
)
def test_fields_that_disagree_and_cameras_without_depth_are_refused(value, change, words):
    error = CalibrationError if value in (LENS, RIG, CAMERA) else ShapeError
    with pytest.raises(error, match=words):
        replace(value, **change)


def test_a_resized_camera_sees_the_same_directions():
    assert CAMERA.doffs_px == 2
    np.testing.assert_array_equal(CAMERA.matrix, [[700, 0, 3], [0, 700, 2], [0, 0, 1]])
    half = CAMERA.resized(3, 2)
    # Edges of the image, at -0.5 and width - 0.5, stay at the same angle.
    for camera in (CAMERA, half):
        edges = (np.array([-0.5, camera.width_px - 0.5]) - camera.cx_px) / camera.focal_px
        np.testing.assert_allclose(edges, [-3.5 / 700, 2.5 / 700], rtol=1e-12)
    assert (half.doffs_px, half.baseline_m, half.ndisp) == (1, 0.5, 17)
    assert half.resized(6, 4).focal_px == CAMERA.focal_px


def test_colours_of_a_grey_pair_are_its_grey_thrice():
    grey, rgb = np.arange(24, dtype=np.uint8).reshape(4, 6), np.zeros((4, 6, 3), np.uint8)
    np.testing.assert_array_equal(replace(PAIR, left=grey).colours[:, :, 1], grey)
    np.testing.assert_array_equal(replace(PAIR, left_rgb=rgb).colours, rgb)


def test_parts_of_a_value_are_rejected_selected_and_summed():
    rejected = DISPARITY.reject(np.array([[True, True], [False, False]]), Reason.EDGE)
    assert rejected.valid.tolist() == [[False, False], [True, True]]
    assert rejected.reason.tolist() == [[Reason.EDGE, Reason.BORDER], [0, 0]]
    assert rejected.confidence.tolist() == [[0, 0], [1, 1]]
    assert np.isnan(rejected.sigma_px[0]).all()
    assert DISPARITY.valid.tolist() == [[True, False], [True, True]]
    chosen = replace(CLOUD, frame="world").select(np.array([False, True, False, True]))
    assert (len(chosen), chosen.xyz[:, 0].tolist(), chosen.sigma_m.tolist()) == (2, [3, 9], [1, 3])
    assert chosen.frame == "world"
    assert PointCloud(CLOUD.xyz).select(np.array([2, 0])).xyz[:, 0].tolist() == [6, 0]
    np.testing.assert_allclose(VOXELS.centres_m, [[0.1, -0.1, 0.5]], atol=1e-12)
    assert (PATH.distances_m.tolist(), PATH.path_length_m) == ([0, 3, 7], 7)
    empty = PATH.select(np.zeros(0, int))
    assert (len(empty), empty.path_length_m) == (0, 0)


GIVEN = np.array([[5.0, np.nan, np.inf], [0.0, -3.0, 7.5]])


def test_disparity_and_truth_are_made_of_any_real_numbers_and_a_mask():
    made = Disparity.from_values(GIVEN)
    assert made.values.dtype == np.float32
    assert made.valid.tolist() == [[True, False, False], [False, False, True]]
    assert made.values[made.valid].tolist() == [5, 7.5]
    assert made.confidence.tolist() == np.float32([[0.9, 0, 0], [0, 0, 0.9]]).tolist()
    assert set(made.sigma_px[made.valid].tolist()) == {0.25}
    assert np.isnan(made.sigma_px[~made.valid]).all()
    assert set(made.reason[~made.valid].tolist()) == {Reason.AMBIGUOUS}
    for dtype in (np.float16, np.float32, np.float64, np.uint8, np.int64):
        made = Disparity.from_values(np.array([[0, 4], [6, 8]], dtype))
        assert made.values[made.valid].tolist() == [4, 6, 8]
    assert Disparity.from_values([[1, 2], [3, 4]]).valid.all()
    masked = np.ma.masked_greater(np.arange(1.0, 7.0).reshape(2, 3), 4)
    assert Disparity.from_values(masked).valid.sum() == 4
    sure = np.where(np.isfinite(GIVEN), 0.5, np.nan)
    rated = Disparity.from_values(GIVEN, confidence=sure, sigma_px=1)
    assert rated.confidence[rated.valid].tolist() == [0.5, 0.5]
    assert rated.sigma_px[rated.valid].tolist() == [1, 1]
    levels = np.array([[255, 255, 255], [255, 255, 128]], np.uint8)
    made = DisparityTruth.from_values(GIVEN, levels)
    assert np.isfinite(made.values).tolist() == [[True, False, False], [False, False, True]]
    assert made.nonocc.tolist() == [[True, False, False], [False, False, False]]
    assert DisparityTruth.from_values(GIVEN, levels == 255).nonocc.sum() == 1
    assert DisparityTruth.from_values(GIVEN).nonocc.sum() == 2
    for mask in (np.ones((2, 3), np.uint8), np.ones((3, 2), bool), 255):
        with pytest.raises(ShapeError, match="not a mask of the ground truth"):
            DisparityTruth.from_values(GIVEN, mask)  # type: ignore[arg-type]


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
def test_what_is_no_disparity_is_refused(values, others, words):
    with pytest.raises(ShapeError, match=words):
        Disparity.from_values(values, **others)  # type: ignore[arg-type]


def test_what_was_measured_and_what_was_inferred_are_told_apart():
    assert BOTH.measured.tolist() == [[True, False], [False, False]]
    assert BOTH.inferred.tolist() == [[False, False], [True, True]]
    assert BOTH.valid.tolist() == [[True, False], [True, True]]
    for mask in (BOTH.measured, BOTH.inferred, BOTH.valid):
        assert not mask.flags.writeable


def test_only_what_was_measured_has_a_value_without_what_was_inferred():
    alone = BOTH.only_measured()
    np.testing.assert_array_equal(alone.values, [[1, NAN], [NAN, NAN]])
    np.testing.assert_array_equal(alone.sigma_px, [[0.5, NAN], [NAN, NAN]])
    assert alone.confidence.tolist() == [[1, 0], [0, 0]]
    assert alone.reason.tolist() == [[0, Reason.BORDER], [Reason.AMBIGUOUS] * 2]
    assert DISPARITY.only_measured() is DISPARITY
    nothing = replace(DISPARITY, reason=np.where(DISPARITY.valid, np.uint8(9), np.uint8(6)))
    assert nothing.inferred.sum() == 3
    assert not nothing.only_measured().valid.any()


ZEROS = np.zeros((500, 3), np.float32)
CELLS = np.full((30, 20), -1, np.int8)
CELLS[:3], CELLS[3:6] = 0, 100
SHOWN = {
    Disparity.from_values(
        [[1, 2], [0, 5]]
    ): "Disparity(2x2, 1 to 5 px, 75.0 % measured, 0.0 % inferred)",
    Disparity.from_values([[NAN]]): "Disparity(1x1, 0.0 % measured, 0.0 % inferred)",
    BOTH: "Disparity(2x2, 1 to 3 px, 25.0 % measured, 50.0 % inferred)",
    DisparityTruth.from_values([[1, 2.5, np.inf, 0]], [[True, False, True, True]]): (
        "DisparityTruth(4x1, 1 to 2.5 px, 50.0 % known, 25.0 % not occluded)"
    ),
    StereoPair(GREY, GREY, name="im0.png", index=3): "StereoPair('im0.png', 6x4 grey, frame 3)",
    LENS: "CameraIntrinsics(6x4, fx 500, fy 500, cx 0, cy 0 px, pinhole [0, 0, 0, 0, 0])",
    RIG: f"StereoCalibration(baseline 0.5 m, {LENS}, {LENS})",
    PointCloud(ZEROS, rgb=ZEROS.astype(np.uint8)): (
        "PointCloud(500 points, x 0 to 0, y 0 to 0, z 0 to 0 m, camera axes, rgb)"
    ),
    PATH: "Trajectory(3 poses, 7 m, 2 s)",
    VOXELS: "OccupancyVoxels(1 voxel of 0.2 m, 1 occupied)",
    recon.OccupancyGrid(CELLS, 0.1, (-1.0, 2.0)): (
        "OccupancyGrid(20x30 cells of 0.1 m, 10.0 % occupied, 10.0 % free, origin (-1.0, 2.0) m)"
    ),
}


@pytest.mark.parametrize("value", SHOWN, ids=lambda value: type(value).__name__)
def test_a_value_is_shown_in_one_line(value):
    assert repr(value) == SHOWN[value]


def test_settings_show_what_differs_from_the_defaults():
    assert repr(recon.load_config()) == "ReconConfig()"
    config = recon.load_config(overrides=["matching.matcher=sgm", "matching.window_px=7"])
    assert repr(config) == ("ReconConfig(matching=MatchingSettings(window_px=7, matcher='sgm'))")


@pytest.mark.parametrize(
    ("text", "board"),
    [
        ("chess:9x6:25mm", CalibrationBoard("chess", 9, 6, 0.025)),
        ("chess:9x6:2.5cm", CalibrationBoard("chess", 9, 6, 0.025)),
        (" Chess:9X6:0.025 ", CalibrationBoard("chess", 9, 6, 0.025)),
        ("chess:9x6:1in", CalibrationBoard("chess", 9, 6, 0.0254)),
        ("chess:9x6", CalibrationBoard("chess", 9, 6, 1.0, metric=False)),
        ("charuco:8x6:30mm:22mm:4x4_50", CalibrationBoard("charuco", 8, 6, 0.03, 0.022, "4X4_50")),
        ("charuco:8x6:40mm", CalibrationBoard("charuco", 8, 6, 0.04, 0.03, "5X5_100")),
    ],
)
def test_a_board_is_read_from_text(text, board):
    read = parse_board(text)
    assert read.square_m == pytest.approx(board.square_m, rel=1e-12)
    assert read.marker_m == pytest.approx(board.marker_m, rel=1e-12)
    assert (read.kind, read.columns, read.rows) == (board.kind, board.columns, board.rows)
    assert (read.dictionary, read.metric) == (board.dictionary, board.metric)


@pytest.mark.parametrize(
    "text",
    [
        "chess:9x6:25mm",
        "charuco:8x6:30mm:22mm:4x4_50",
        "charuco:8x6:30mm:22mm:4x4_50:legacy",
        "aprilgrid:6x6:88mm:0.3",
        "aprilgrid:6x6:88mm:0.3:thin",
        "circles:7x6:20mm:10mm",
        "acircles:4x11:20mm:16mm",
    ],
)
def test_a_board_tells_itself_as_it_is_read(text):
    assert str(parse_board(text)) == text


NO_BOARDS = (
    "9x6", "chess", "chess:9", "chess:9x6:25kg", "chess:9x6:25mm:3mm", "",
    "circles:4x5:3mm:2mm:1mm",    "aprilgrid:6x6:88mm:0.3:legacy", "aprilgrid:6x6:88mm:wide",
    "charuco:8x6:30mm:22mm:4x4_50:older",
)  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *((text, "cannot read this board.*chess:9x6:25mm.*charuco:8x6") for text in NO_BOARDS),
        ("chess:9x6:25", "implausible.*got 25 m.*25mm"),
        ("chess:9x1:25mm", "too few inner corners"),
        ("charuco:8x6:30mm:30mm", "markers must be smaller"),
        ("chess:9x6:0mm", "implausible"),
        ("circles:9x6:20mm:20mm", "circles than the step"),
    ],
)
def test_what_is_no_board_or_cannot_be_one_is_refused(text, message):
    with pytest.raises(SettingsError, match=message):
        parse_board(text)

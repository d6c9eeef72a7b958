"""Lens models in closed form: inverse of each other, as their papers say, and rectified."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import CalibrationError
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import CameraIntrinsics, LensModel, StereoCalibration
from recon.stereo.rectify.closed import CLOSED_FORMS
from recon.stereo.rectify.lens import central_focal_px, project_raw, rays_of
from recon.stereo.rectify.rectifier import Rectifier, plan_turns

SIZE = (640, 480)
# Ranges of coefficients that calibrations have, by model.
RANGES: dict[LensModel, list[tuple[float, float]]] = {
    "ds": [(-0.4, 0.4), (0.3, 0.75)],
    "eucm": [(0.0, 0.8), (0.5, 2.0)],
    "fov": [(0.3, 1.4)],
    "omni": [(0.5, 2.5), (-0.05, 0.2), (-0.02, 0.02), (-0.005, 0.005), (-0.005, 0.005)],
}
#: Half the cone of directions whose place is asked for, in degrees, and whether the model has it.
CONE_DEG = {"ds": 95.0, "eucm": 95.0, "fov": 110.0, "omni": 60.0}
LENSES = [
    st.tuples(st.just(model), st.tuples(*(st.floats(*each) for each in ranges)))
    for model, ranges in RANGES.items()
]


def camera(model: LensModel, lens: tuple[float, ...], f: float = 300.0) -> CameraIntrinsics:
    matrix = np.array([[f, 0.3, 318.0], [0, f * 1.01, 242.0], [0, 0, 1]])
    return CameraIntrinsics(matrix, np.array(lens, dtype=np.float64), *SIZE, model)


def directions(widest_deg: float) -> np.ndarray:
    away, around = np.meshgrid(np.radians(np.linspace(0, widest_deg, 40)), np.arange(0, 6.28, 0.5))
    flat = np.sin(away), np.cos(away)
    return np.stack([flat[0] * np.cos(around), flat[0] * np.sin(around), flat[1]], -1).reshape(
        -1, 3
    )


@given(st.one_of(LENSES), st.floats(0.01, 100.0))
def test_what_a_lens_projects_comes_back_along_the_same_direction(lens, length):
    model, coefficients = lens
    (project, unproject), given_to = CLOSED_FORMS[model], np.array(coefficients)
    with np.errstate(all="ignore"):
        xyz = directions(CONE_DEG[model])
        plane = project(given_to, length * xyz)
        back = unproject(given_to, plane)
    seen = np.isfinite(plane).all(axis=1)
    assert seen[directions(CONE_DEG[model])[:, 2] > 0.5].all()  # 60 degrees are always seen
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    # A hundred roundings, and near the end of a model its slope, of at most a thousand.
    np.testing.assert_allclose(back[seen], xyz[seen], atol=1e-6)


@given(st.one_of(LENSES))
def test_pixels_have_rays_that_lead_back_or_none(lens):
    one = camera(*lens)
    grid = np.stack(np.meshgrid(np.linspace(-900, 1500, 60), np.linspace(-900, 1500, 60)), -1)
    pixels = grid.reshape(-1, 2)
    rays = rays_of(one, pixels)
    known = np.isfinite(rays).all(axis=1)
    assert known.any()
    np.testing.assert_array_equal(rays[known, 2], 1.0)
    if lens[0] != "omni":  # whose polynomial folds back far outside of the image
        near = known & (np.abs(rays[:, :2]).max(axis=1) < 50)
        np.testing.assert_allclose(project_raw(one, rays[near]), pixels[near], atol=1e-6)
    np.testing.assert_array_equal(np.isnan(rays).any(axis=1), np.isnan(rays).all(axis=1))


@pytest.mark.parametrize(("model", "lens"), [("ds", (0, 0)), ("eucm", (0, 1)), ("fov", (0,)),
                                             ("omni", (0, -0.2, 0.05, 1e-3, -2e-3))])  # fmt: skip
def test_a_lens_without_its_bending_is_a_pinhole(model, lens):
    xyz = directions(70.0)[1:]
    terms = np.array(lens[1:]) if model == "omni" else np.zeros(4)
    K = np.array(camera(model, lens).matrix)
    K[0, 1] = 0  # which OpenCV does not have
    one = CameraIntrinsics(K, np.array(lens, dtype=np.float64), *SIZE, model)
    want = cv2.projectPoints(xyz.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, terms)[0]
    np.testing.assert_allclose(project_raw(one, xyz), want[:, 0], rtol=1e-7, atol=1e-6)


def test_models_are_those_of_their_papers():
    """Written out anew, for one point and one lens of each."""
    x, y, z = xyz = np.array([0.7, -0.4, 0.9])
    xi, alpha, d = -0.2, 0.6, np.linalg.norm(xyz)
    far = np.sqrt(x * x + y * y + (xi * d + z) ** 2)
    ds = xyz[:2] / (alpha * far + (1 - alpha) * (xi * d + z))
    eucm = xyz[:2] / (0.6 * np.sqrt(1.1 * (x * x + y * y) + z * z) + 0.4 * z)
    r = np.hypot(x, y) / z
    fov = xyz[:2] / z * np.arctan(2 * r * np.tan(0.45)) / 0.9 / r
    sphere = xyz / d
    m = sphere[:2] / (sphere[2] + 1.5)
    r2 = m @ m
    omni = m * (1 - 0.1 * r2 + 0.02 * r2**2) + [
        2 * 0.003 * m[0] * m[1] - 0.004 * (r2 + 2 * m[0] ** 2),
        0.003 * (r2 + 2 * m[1] ** 2) - 2 * 0.004 * m[0] * m[1],
    ]
    lenses = {"ds": (xi, alpha), "eucm": (0.6, 1.1), "fov": (0.9,)}
    lenses["omni"] = (1.5, -0.1, 0.02, 0.003, -0.004)
    for (model, lens), want in zip(lenses.items(), (ds, eucm, fov, omni), strict=True):
        got = CLOSED_FORMS[model][0](np.array(lens), xyz[None])[0]
        np.testing.assert_allclose(got, want, rtol=1e-14, err_msg=model)


@pytest.mark.parametrize(("model", "lens"), [("ds", (2.0, 0.5)), ("ds", (0.1, 1.2)),
                                             ("eucm", (0.5,)), ("eucm", (0.5, -1.0)),
                                             ("fov", (4.0,)),
                                             ("omni", (-1.0, 0, 0, 0, 0))])  # fmt: skip
def test_coefficients_that_no_lens_has_are_refused(model, lens):
    with pytest.raises(CalibrationError, match=f"lens model {model}"):
        camera(model, lens)


def drawn(one: CameraIntrinsics, T: np.ndarray) -> np.ndarray:
    """What a camera sees of a textured wall at 2 m, by the ray of each pixel."""
    pixels = np.stack(np.meshgrid(*map(np.arange, SIZE)), -1).reshape(-1, 2).astype(np.float64)
    rays = rays_of(one, pixels)
    back = np.linalg.inv(T)
    way = rays @ back[:3, :3].T
    at = back[:3, 3] + way * ((2.0 - back[2, 3]) / way[:, 2:])
    waves = sum(np.sin(k * at[:, 0] + 1.7 * k * at[:, 1] + k) for k in (3.0, 7.1, 11.3, 23.0))
    waves += sum(np.sin(k * at[:, 1] - 0.6 * k * at[:, 0]) for k in (5.0, 13.0, 19.0))
    grey = np.nan_to_num(128 + 16 * waves).clip(0, 255)
    return grey.reshape(SIZE[::-1]).astype(np.uint8)


WIDE = {
    "ds": (-0.2, 0.6), "eucm": (0.6, 1.1), "fov": (0.9,), "omni": (1.2, -0.1, 0.01, 1e-3, -1e-3)
}  # fmt: skip


@pytest.mark.parametrize("model", WIDE)
def test_images_of_a_lens_have_matching_rows_and_the_depth_of_the_wall(model):
    """Matched by OpenCV alone: what a wall of 2 m looks like through two turned cameras."""
    T = make_transform(exp_so3(np.array([0.02, -0.03, 0.01])), np.array([-0.2, 0.003, -0.004]))
    left, right = camera(model, WIDE[model], 350.0), camera(model, WIDE[model], 347.0)
    rectifier = Rectifier(StereoCalibration(left, right, T))
    tables = rectifier._views
    assert tables is not None
    a, b = tables[0].warp(drawn(left, np.eye(4))), tables[1].warp(drawn(right, T))
    # The middle half of the view sees the wall with both cameras.
    points = np.stack(np.meshgrid(np.arange(220, 520, 20), np.arange(140, 340, 20)), -1)
    start = points.reshape(-1, 1, 2).astype(np.float32)
    found, known, _ = cv2.calcOpticalFlowPyrLK(a, b, start, None, winSize=(21, 21), maxLevel=5)
    off = (found - start)[known.ravel() == 1, 0]
    assert len(off) > 100
    assert np.median(np.abs(off[:, 1])) < 0.05
    rig = StereoCalibration(left, right, T)
    K, R = rectifier.camera.matrix, plan_turns(rig, rectifier.settings).R_left
    rays = np.column_stack([start[known.ravel() == 1, 0], np.ones(len(off))]) @ np.linalg.inv(K).T
    raw = rays @ R  # to the axes of the left camera, where the wall is z = 2
    want = rectifier.camera.focal_px * rectifier.camera.baseline_m / (2.0 / raw[:, 2])
    doffs = rectifier.camera.doffs_px
    assert np.median(np.abs(-off[:, 0] - (want - doffs))) < 0.1


def test_the_centre_of_a_rectified_view_keeps_the_resolution_of_the_lens():
    for model, lens in WIDE.items():
        one = camera(model, lens)
        seen = project_raw(one, np.array([[0, 0, 1.0], [1e-4, 0, 1.0]]))
        assert central_focal_px(one) == pytest.approx((seen[1, 0] - seen[0, 0]) / 1e-4, rel=1e-3)

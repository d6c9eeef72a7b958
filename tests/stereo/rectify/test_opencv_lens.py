from __future__ import annotations

import numpy as np
import pytest

from recon.core.values import CameraIntrinsics, LensModel
from recon.stereo.rectify.lens import project_raw, project_with_jacobian, rays_of

LENSES: list[tuple[LensModel, list[float]]] = [
    ("pinhole", []),
    ("pinhole", [-0.3, 0.1, 1e-3, -2e-3]),
    ("pinhole", [-0.3, 0.1, 1e-3, -2e-3, 0.01]),
    ("pinhole", [-0.3, 0.1, 1e-3, -2e-3, 0.01, 0.02, 0.03, 1e-3]),
    ("fisheye", [0.02, -0.01, 2e-3, 1e-3]),
]
XYZ = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 4), (20, 3))
STEP = 1e-6


def lens(model: LensModel, numbers: np.ndarray) -> CameraIntrinsics:
    fx, fy, cx, cy = numbers[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return CameraIntrinsics(matrix, numbers[4:], 640, 480, model)


@pytest.mark.parametrize(("model", "coefficients"), LENSES)
def test_a_ray_of_a_pixel_leads_back_to_the_point(
    model: LensModel, coefficients: list[float]
) -> None:
    camera = lens(model, np.array([500.0, 501, 320, 240, *coefficients]))
    rays = rays_of(camera, project_raw(camera, XYZ))
    np.testing.assert_allclose(rays, XYZ / XYZ[:, 2:], atol=1e-9)


@pytest.mark.parametrize(("model", "coefficients"), LENSES)
def test_derivatives_are_those_of_small_differences(
    model: LensModel, coefficients: list[float]
) -> None:
    numbers = np.array([500.0, 501, 320, 240, *coefficients])
    _, by_point, by_lens = project_with_jacobian(lens(model, numbers), XYZ)

    def slope(move: np.ndarray, of_lens: bool) -> np.ndarray:
        ends = [
            project_raw(
                lens(model, numbers + s * move if of_lens else numbers),
                XYZ if of_lens else XYZ + s * move,
            )
            for s in (STEP, -STEP)
        ]
        return (ends[0] - ends[1]) / (2 * STEP)

    points = np.stack([slope(axis, of_lens=False) for axis in np.eye(3)], axis=-1)
    lenses = np.stack([slope(axis, of_lens=True) for axis in np.eye(len(numbers))], axis=-1)
    # Central differences of pixels of size 1e3 in double precision: 1e3 * 1e-16 / 1e-6.
    np.testing.assert_allclose(by_point, points, atol=1e-6)
    np.testing.assert_allclose(by_lens, lenses, atol=1e-6)


@pytest.mark.parametrize(("model", "coefficients"), LENSES)
def test_what_is_behind_the_camera_has_no_pixel(
    model: LensModel, coefficients: list[float]
) -> None:
    camera = lens(model, np.array([500.0, 501, 320, 240, *coefficients]))
    assert np.isnan(project_raw(camera, np.array([[0.1, 0.2, -1.0], [0.1, 0.2, 0.0]]))).all()


def test_rays_at_ninety_degrees_and_more_are_nan() -> None:
    camera = lens("fisheye", np.array([100.0, 100, 320, 240, 0, 0, 0, 0]))
    rays = rays_of(camera, np.array([[320 + 100 * 1.5, 240], [320 + 100 * 1.7, 240]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).any()

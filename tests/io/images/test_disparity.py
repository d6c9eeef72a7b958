from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from recon.core.errors import FormatError, OutputError, ShapeError
from recon.io.images.disparity import (
    fitting_scale,
    read_disparity_png,
    read_pfm,
    write_disparity_png,
    write_pfm,
)
from recon.io.images.image import write_image

DISPARITIES = arrays(
    np.float32,
    st.tuples(st.integers(1, 6), st.integers(1, 6)),
    elements=st.one_of(st.floats(-1e6, 1e6, width=32), st.just(float("nan"))),
)


@settings(max_examples=50)
@given(values=DISPARITIES)
def test_pfm_gives_back_every_bit(
    values: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "values.pfm"
    write_pfm(path, values)
    read = read_pfm(path)
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, values)


def test_unknown_is_inf_in_the_file_and_rows_run_upwards(tmp_path: Path) -> None:
    write_pfm(tmp_path / "a.pfm", np.array([[np.nan, 1.0], [2.0, 3.0]], dtype=np.float32))
    content = (tmp_path / "a.pfm").read_bytes()
    assert content.startswith(b"Pf\n2 2\n-1.0\n")
    assert np.frombuffer(content[-16:], "<f4").tolist() == [2.0, 3.0, np.inf, 1.0]


@pytest.mark.parametrize(
    ("order", "scale"), [("<f4", "-1"), (">f4", "1.0"), ("<f4", "-0.003922"), (">f4", "2e3")]
)
def test_both_byte_orders_are_read_and_the_magnitude_of_the_scale_changes_nothing(
    tmp_path: Path, order: str, scale: str
) -> None:
    body = np.array([3.0, np.inf, -np.inf, 4.5], dtype=order).tobytes()
    (tmp_path / "a.pfm").write_bytes(f"Pf\n2 2\n{scale}\n".encode() + body)
    np.testing.assert_array_equal(read_pfm(tmp_path / "a.pfm"), [[np.nan, 4.5], [3.0, np.nan]])


def test_float64_is_not_cut_to_float32_silently(tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match="got float64"):
        write_pfm(tmp_path / "a.pfm", np.zeros((2, 2)))


NAN = float("nan")


@settings(max_examples=40)
@given(
    values=arrays(
        np.float32,
        st.tuples(st.integers(1, 5), st.integers(1, 5)),
        elements=st.one_of(st.floats(np.float32(0.005), 250, width=32), st.just(NAN)),
    )
)
def test_disparity_comes_back_within_half_a_level_and_nan_as_nan(
    values: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "disparity.png"
    write_disparity_png(path, values)
    read = read_disparity_png(path)
    np.testing.assert_array_equal(np.isnan(read), np.isnan(values))
    np.testing.assert_allclose(read, values, rtol=0, atol=0.5 / 256 + 1e-5)


def test_the_file_is_kittis(tmp_path: Path) -> None:
    values = np.array([[NAN, 0.0, 1.0, 200.5]], dtype=np.float32)
    write_disparity_png(tmp_path / "a.png", values)
    levels = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    assert levels.dtype == np.uint16
    assert levels.tolist() == [[0, 1, 256, 51328]]


@pytest.mark.parametrize("scale", [4, 8, 16])
def test_eight_bit_truth_is_divided_by_its_scale(tmp_path: Path, scale: int) -> None:
    write_image(tmp_path / "disp.pgm", np.array([[0, 1, 240]], dtype=np.uint8))
    values = read_disparity_png(tmp_path / "disp.pgm", scale=scale)
    np.testing.assert_array_equal(values, np.array([[NAN, 1 / scale, 240 / scale]], "f4"))


def test_eight_bits_are_no_kitti_disparity(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", np.ones((2, 2), dtype=np.uint8))
    with pytest.raises(FormatError, match=r"a\.png: disparity image has 8 bits"):
        read_disparity_png(tmp_path / "a.png")


@pytest.mark.parametrize("value", [-0.1, 256.0])
def test_what_does_not_fit_is_refused_and_not_clipped(tmp_path: Path, value: float) -> None:
    with pytest.raises(OutputError, match=r"a\.png: disparity does not fit.*write PFM"):
        write_disparity_png(tmp_path / "a.png", np.array([[value, NAN]], dtype=np.float32))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("top", "scale"), [(10, 256), (255.9, 256), (256, 128), (600, 64)])
def test_fitting_scale_is_the_largest_that_fits(tmp_path: Path, top: float, scale: float) -> None:
    values = np.array([[top, NAN]], dtype=np.float32)
    assert fitting_scale(values) == scale
    write_disparity_png(tmp_path / "a.png", values, scale=scale)


def test_fitting_scale_of_nothing_is_kittis() -> None:
    assert fitting_scale(np.full((2, 2), NAN, dtype=np.float32)) == 256

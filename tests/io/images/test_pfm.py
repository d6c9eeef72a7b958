from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from recon.core.errors import FormatError, ShapeError
from recon.io.images.disparity import read_pfm, write_pfm

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


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "file does not exist"),
        (b"", "file is empty"),
        (b"P5\n1 1\n255\n\x00", "not a PFM file"),
        (b"PF\n1 1\n-1\n" + bytes(12), "PFM file is in colour"),
        (b"Pf\n2 2\n-1\n" + bytes(12), r"truncated \(got 12 bytes, expected 16 for 2x2 pixels\)"),
        (b"Pf\n0 2\n-1\n" + bytes(12), "truncated"),
        (b"Pf\n1 1\n0\n" + bytes(4), r"scale .* \(got 0\)"),
        (b"Pf\n1 1\n1-1\n" + bytes(4), r"scale .* \(got 1-1\)"),
    ],
)
def test_a_bad_pfm_is_one_clear_line_with_the_file(
    tmp_path: Path, content: bytes | None, message: str
) -> None:
    path = tmp_path / "disp0.pfm"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(FormatError, match=rf"disp0\.pfm: .*{message}"):
        read_pfm(path)


def test_float64_is_not_cut_to_float32_silently(tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match="got float64"):
        write_pfm(tmp_path / "a.pfm", np.zeros((2, 2)))

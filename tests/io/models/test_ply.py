"""PLY clouds: round trips, other readers, and damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pymeshlab
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from recon.core.errors import FormatError
from recon.core.values import PointCloud
from recon.io.models.ply import read_ply, write_ply

FIELDS = ("rgb", "normals", "confidence", "sigma_m", "weight", "count")
NUMBERS = st.floats(-1e6, 1e6, width=32)
SHARES = st.floats(0, 1, width=32)


@st.composite
def clouds(draw: st.DrawFn) -> PointCloud:
    n = draw(st.integers(0, 12))
    parts = {
        "rgb": arrays(np.uint8, (n, 3)),
        "normals": arrays(np.float32, (n, 3), elements=NUMBERS),
        "confidence": arrays(np.float32, n, elements=SHARES),
        "sigma_m": arrays(np.float32, n, elements=SHARES),
        "weight": arrays(np.float32, n, elements=NUMBERS),
        "count": arrays(np.int32, n, elements=st.integers(0, 2**31 - 1)),
    }
    return PointCloud(
        xyz=draw(arrays(np.float32, (n, 3), elements=NUMBERS)),
        frame=draw(st.sampled_from(["camera", "world", "map"])),
        **{name: draw(part) for name, part in parts.items() if draw(st.booleans())},
    )


def example_cloud(n: int = 20) -> PointCloud:
    rng = np.random.default_rng(1)
    normals = rng.standard_normal((n, 3))
    return PointCloud(
        xyz=rng.standard_normal((n, 3)).astype(np.float32),
        rgb=rng.integers(0, 256, (n, 3), dtype=np.uint8),
        normals=(normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        sigma_m=rng.random(n).astype(np.float32),
        confidence=rng.random(n).astype(np.float32),
        weight=rng.random(n).astype(np.float32),
        count=rng.integers(1, 9, n).astype(np.int32),
    )


@pytest.mark.parametrize("ascii", [False, True])
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cloud=clouds())
def test_a_cloud_comes_back_bit_by_bit(tmp_path: Path, ascii: bool, cloud: PointCloud) -> None:  # noqa: A002
    path = tmp_path / "cloud.ply"
    write_ply(path, cloud, ascii=ascii)
    again = read_ply(path)
    np.testing.assert_array_equal(again.xyz, cloud.xyz)
    assert again.frame == cloud.frame
    for name in FIELDS:
        expected, got = getattr(cloud, name), getattr(again, name)
        assert (got is None) == (expected is None)
        if expected is not None:
            np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize("ascii", [False, True])
def test_meshlab_reads_positions_normals_colours_and_quality(tmp_path: Path, ascii: bool) -> None:  # noqa: A002
    cloud = example_cloud()
    write_ply(tmp_path / "cloud.ply", cloud, ascii=ascii)
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(tmp_path / "cloud.ply"))
    seen = meshes.current_mesh()
    np.testing.assert_array_equal(seen.vertex_matrix().astype(np.float32), cloud.xyz)
    np.testing.assert_array_equal(seen.vertex_normal_matrix().astype(np.float32), cloud.normals)
    np.testing.assert_array_equal(seen.vertex_scalar_array().astype(np.float32), cloud.confidence)
    np.testing.assert_array_equal(np.rint(seen.vertex_color_matrix()[:, :3] * 255), cloud.rgb)


def test_open3d_reads_it_as_float_with_every_scalar(tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d")
    cloud = example_cloud()
    write_ply(tmp_path / "cloud.ply", cloud)
    seen = o3d.t.io.read_point_cloud(str(tmp_path / "cloud.ply"))
    assert seen.point.positions.numpy().dtype == np.float32
    np.testing.assert_array_equal(seen.point.positions.numpy(), cloud.xyz)
    np.testing.assert_array_equal(seen.point["sigma"].numpy()[:, 0], cloud.sigma_m)
    np.testing.assert_array_equal(seen.point["count"].numpy()[:, 0], cloud.count)


@pytest.mark.parametrize("binary", [True, False])
def test_what_pymeshlab_writes_is_read(tmp_path: Path, binary: bool) -> None:
    cloud = example_cloud()
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(
        pymeshlab.Mesh(
            vertex_matrix=cloud.xyz.astype(np.float64),
            v_normals_matrix=cloud.normals.astype(np.float64),
        )
    )
    meshes.save_current_mesh(str(tmp_path / "theirs.ply"), binary=binary, save_vertex_normal=True)
    again = read_ply(tmp_path / "theirs.ply")
    # Text holds six digits.
    np.testing.assert_allclose(again.xyz, cloud.xyz, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(again.normals, cloud.normals, rtol=1e-4, atol=1e-5)


def write_raw(path: Path, properties: str, body: bytes, count: int, kind: str = "ascii") -> Path:
    head = f"ply\nformat {kind} 1.0\nelement vertex {count}\n{properties}\nend_header\n"
    path.write_bytes(head.encode() + body)
    return path


XYZ = "property float x\nproperty float y\nproperty float z"


def test_big_endian_doubles_and_unknown_properties_are_read(tmp_path: Path) -> None:
    table = np.zeros(2, [("t", ">u2"), ("x", ">f8"), ("y", ">f8"), ("z", ">f8")])
    table["x"], table["z"] = [1.5, -2.5], [3.25, 4.0]
    properties = "property ushort t\n" + XYZ.replace("float", "double")
    path = write_raw(tmp_path / "a.ply", properties, table.tobytes(), 2, kind="binary_big_endian")
    np.testing.assert_array_equal(read_ply(path).xyz, [[1.5, 0, 3.25], [-2.5, 0, 4]])


def test_points_that_are_not_finite_are_dropped_with_their_attributes(tmp_path: Path) -> None:
    path = write_raw(
        tmp_path / "a.ply",
        XYZ + "\nproperty float sigma",
        b"1 2 3 0.1\nnan 2 3 0.2\n4 5 inf 0.3\n7 8 9 0.4\n",
        4,
    )
    cloud = read_ply(path)
    np.testing.assert_array_equal(cloud.xyz, [[1, 2, 3], [7, 8, 9]])
    np.testing.assert_array_equal(cloud.sigma_m, np.float32([0.1, 0.4]))


def test_a_quality_that_is_no_confidence_is_left_out(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "a.ply", XYZ + "\nproperty float quality", b"1 2 3 17\n", 1)
    assert read_ply(path).confidence is None


@pytest.mark.parametrize("ascii", [False, True])
def test_a_truncated_file_is_refused(tmp_path: Path, ascii: bool) -> None:  # noqa: A002
    path = tmp_path / "cloud.ply"
    write_ply(path, example_cloud(), ascii=ascii)
    whole = path.read_bytes()
    for cut in (1 if not ascii else 40, 300):
        path.write_bytes(whole[:-cut])
        with pytest.raises(FormatError, match="truncated"):
            read_ply(path)


def test_a_header_that_promises_more_than_memory_is_refused(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "a.ply", XYZ, b"\0" * 24, 10**15, kind="binary_little_endian")
    with pytest.raises(FormatError, match="truncated"):
        read_ply(path)


def test_survey_coordinates_that_would_become_steps_are_refused(tmp_path: Path) -> None:
    xyz = np.array([4.5e5, 5.4e6, 300]) + np.random.default_rng(0).uniform(0, 10, (100, 3))
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 100\nproperty double x\n"
    header += "property double y\nproperty double z\nend_header\n"
    path = tmp_path / "utm.ply"
    path.write_bytes(header.encode() + xyz.astype("<f8").tobytes())
    with pytest.raises(FormatError, match=r"utm\.ply: .* \(got x up to 4500.*subtract an offset"):
        read_ply(path)
    path.write_bytes(header.encode() + (xyz - xyz[0]).astype("<f8").tobytes())
    read_ply(path)

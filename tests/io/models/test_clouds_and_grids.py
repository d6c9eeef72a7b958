"""Clouds, OctoMaps and Nav2 grids as files: round trips, other programs, and damage."""

import gc
import resource
import shutil
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import open3d
import pymeshlab
import pyoctomap
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import cKDTree

from recon.core.errors import (
    EvaluationError,
    FormatError,
    MappingError,
    MissingDependencyError,
    OutputError,
    SettingsError,
)
from recon.core.geometry.se3 import make_transform
from recon.core.values import (
    ATTRIBUTES,
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    OccupancyVoxels,
    PointCloud,
    join_clouds,
)
from recon.io.models.columns import write_npz, write_pcd
from recon.io.models.las import check_crs, check_inside, write_copc, write_e57, write_las
from recon.io.models.octomap import KEY_LIMIT, octomap_pieces, read_octomap, write_octomap_tiles
from recon.io.models.ply import read_ply, write_ply, write_ply_tiles
from recon.io.models.rasters import (
    RasterPlace,
    read_grid,
    write_geotiff,
    write_nav2,
    write_nav2_costs,
)
from recon.io.ros.bag import write_bag
from recon.io.ros.messages import header, points
from tests.scenery.octomaps import write_octomap

NUMBERS = st.floats(-1e6, 1e6, width=32)
SHARES = st.floats(0, 1, width=32)


@st.composite
def clouds(draw: st.DrawFn) -> PointCloud:
    n = draw(st.integers(0, 12))
    parts = {
        each.name: arrays(
            each.dtype,
            each.shape(n),
            elements={
                np.float32: SHARES if each.bounds else NUMBERS,
                np.uint8: st.integers(*map(int, each.bounds or (0, 255))),
            }.get(each.dtype),
        )
        for each in ATTRIBUTES
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
def test_a_cloud_comes_back_bit_by_bit(tmp_path, ascii, cloud):  # noqa: A002
    write_ply(tmp_path / "cloud.ply", cloud, ascii=ascii)
    again = read_ply(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(again.xyz, cloud.xyz)
    assert again.frame == cloud.frame
    assert [*again.arrays] == [*cloud.arrays]
    for name, values in cloud.arrays.items():
        np.testing.assert_array_equal(again.arrays[name], values)


@pytest.mark.parametrize("ascii", [False, True])
def test_meshlab_reads_positions_normals_colours_and_quality(tmp_path, ascii):  # noqa: A002
    cloud = example_cloud()
    write_ply(tmp_path / "cloud.ply", cloud, ascii=ascii)
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(tmp_path / "cloud.ply"))
    seen = meshes.current_mesh()
    np.testing.assert_array_equal(seen.vertex_matrix().astype(np.float32), cloud.xyz)
    np.testing.assert_array_equal(seen.vertex_normal_matrix().astype(np.float32), cloud.normals)
    np.testing.assert_array_equal(seen.vertex_scalar_array().astype(np.float32), cloud.confidence)
    np.testing.assert_array_equal(np.rint(seen.vertex_color_matrix()[:, :3] * 255), cloud.rgb)


@pytest.mark.parametrize("binary", [True, False])
def test_what_pymeshlab_writes_is_read(tmp_path, binary):
    cloud = example_cloud()
    xyz, normals = cloud.xyz.astype(np.float64), cloud.normals.astype(np.float64)
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=xyz, v_normals_matrix=normals))
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
DOUBLES = XYZ.replace("float", "double")


def test_other_clouds_are_read_without_what_is_not_finite_or_no_confidence(tmp_path):
    table = np.zeros(2, [("t", ">u2"), ("x", ">f8"), ("y", ">f8"), ("z", ">f8")])
    table["x"], table["z"] = [1.5, -2.5], [3.25, 4.0]
    properties = f"property ushort t\n{DOUBLES}"
    path = write_raw(tmp_path / "a.ply", properties, table.tobytes(), 2, kind="binary_big_endian")
    np.testing.assert_array_equal(read_ply(path).xyz, [[1.5, 0, 3.25], [-2.5, 0, 4]])
    body = b"1 2 3 0.1\nnan 2 3 0.2\n4 5 inf 0.3\n7 8 9 0.4\n"
    cloud = read_ply(write_raw(tmp_path / "a.ply", XYZ + "\nproperty float sigma", body, 4))
    np.testing.assert_array_equal(cloud.xyz, [[1, 2, 3], [7, 8, 9]])
    np.testing.assert_array_equal(cloud.sigma_m, np.float32([0.1, 0.4]))
    path = write_raw(tmp_path / "b.ply", XYZ + "\nproperty float quality", b"1 2 3 17\n", 1)
    assert read_ply(path).confidence is None


def test_a_header_of_more_than_memory_and_coordinates_that_would_become_steps_are_refused(tmp_path):
    path = write_raw(tmp_path / "a.ply", XYZ, b"\0" * 24, 10**15, kind="binary_little_endian")
    with pytest.raises(FormatError, match="truncated"):
        read_ply(path)
    xyz = np.array([4.5e5, 5.4e6, 300]) + np.random.default_rng(0).uniform(0, 10, (100, 3))
    path, kind = tmp_path / "utm.ply", "binary_little_endian"
    write_raw(path, DOUBLES, xyz.astype("<f8").tobytes(), 100, kind)
    with pytest.raises(FormatError, match=r"utm\.ply: .* \(got x up to 4500.*subtract an offset"):
        read_ply(path)
    read_ply(write_raw(path, DOUBLES, (xyz - xyz[0]).astype("<f8").tobytes(), 100, kind))


def test_clouds_one_after_another_are_one_cloud_in_a_file_and_an_error_leaves_none(tmp_path):
    tiles = [example_cloud(7 + 100 * number) for number in range(4)]
    assert write_ply_tiles(tmp_path / "a.ply", iter(tiles), frame="map") == 628
    back = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(back.xyz, np.concatenate([tile.xyz for tile in tiles]))
    assert back.frame == "map"
    assert write_ply_tiles(tmp_path / "a.ply", iter([]), frame="map") == 0
    assert b"element vertex 0\n" in (tmp_path / "a.ply").read_bytes()

    def failing() -> Iterator[PointCloud]:
        yield tiles[0]
        raise OutputError("disk full")

    with pytest.raises(OutputError):
        write_ply_tiles(tmp_path / "b.ply", failing(), frame="map")
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


T_SURVEY_MAP = make_transform(
    np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    np.array([456789.25, 5433210.5, 118.75]),
)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_points_of_a_survey_come_back_turned_and_moved(tmp_path, suffix):
    laspy = pytest.importorskip("laspy")
    parts = [example_cloud(1000), example_cloud(10)]
    path = tmp_path / f"cloud.{suffix}"
    assert write_las(path, parts, T_SURVEY_MAP, "EPSG:25832") == 1010
    found = laspy.read(path)
    x, y, z = np.concatenate([cloud.xyz for cloud in parts]).astype(np.float64).T
    expected = np.stack([456789.25 - y, 5433210.5 + x, 118.75 + z], axis=1)
    assert np.abs(found.xyz - expected).max() <= 0.00051
    rgb = np.concatenate([cloud.rgb for cloud in parts]).astype(np.uint16)
    for n, name in enumerate(("red", "green", "blue")):
        np.testing.assert_array_equal(found[name], rgb[:, n] * 257)
    np.testing.assert_array_equal(found["sigma"], np.concatenate([c.sigma_m for c in parts]))
    assert found.header.parse_crs().to_epsg() == 25832
    np.testing.assert_allclose(found.header.maxs, expected.max(axis=0), atol=0.001)
    # Each point is the only return of its ray; the specification permits no 0.
    assert set(found.return_number) == set(found.number_of_returns) == {1}
    assert found.header.number_of_points_by_return[0] == 1010
    assert set(found.classification) == {1}  # unclassified; 0 would be: never looked at
    write_las(path, [PointCloud(np.ones((1, 3), np.float32))], np.eye(4))
    found = laspy.read(path)
    np.testing.assert_allclose(found.xyz, 1.0)
    assert [*found.point_format.extra_dimension_names] == []  # these have no sigma
    assert found.header.parse_crs() is None
    assert found.header.global_encoding.wkt  # as points of this format need


@pytest.mark.parametrize("points", [0, 1, 3000])
def test_a_copc_is_read_as_far_as_a_view_needs(tmp_path, points):
    laspy = pytest.importorskip("laspy")
    random, path = np.random.default_rng(3), tmp_path / "cloud.copc.laz"
    cloud = replace(example_cloud(points), xyz=random.random((points, 3), np.float32) * 100)
    clouds = [cloud.select(np.arange(points) % 3 == part) for part in range(3)]
    assert write_copc(path, clouds, T_SURVEY_MAP, "EPSG:25832", step_m=0.01) == points
    with laspy.CopcReader.open(path) as file:
        assert file.header.parse_crs().to_epsg() == 25832
        parts = [file.query(level=depth) for depth in range(6)]
        found = file.query()
        assert sum(map(len, parts)) == len(found) == points
        if points < 2:
            return
        low, side = file.copc_info.center - file.copc_info.halfsize, 2 * file.copc_info.halfsize
        x, y, z = cloud.xyz.astype(np.float64).T
        expected = np.stack([456789.25 - y, 5433210.5 + x, 118.75 + z], axis=1)
        places = [np.stack([part.x, part.y, part.z], axis=1) for part in parts]
        rows = cKDTree(expected).query(np.concatenate(places))[1]
        assert len({*rows.tolist()}) == points
        assert np.abs(np.concatenate(places) - expected[rows]).max() < 0.0051
        sigma = np.concatenate([np.array(part["sigma"]) for part in parts])
        np.testing.assert_array_equal(sigma, cloud.sigma_m[rows])
        red = np.concatenate([np.array(part["red"]) for part in parts])
        np.testing.assert_array_equal(red, cloud.rgb[rows, 0].astype(np.uint16) * 257)
        # No cell of a depth has two of its points, and a part of the cloud is found by its box.
        for depth, xyz in enumerate(places[:2]):
            cells = np.floor((xyz - low) / side * (128 << depth))
            assert len(np.unique(cells, axis=0)) == len(cells) > 0
        box = laspy.copc.Bounds(low, low + side / 4)
        inside = ((expected >= box.mins) & (expected <= box.maxs)).all(axis=1).sum()
        assert len(file.query(box)) == inside
    assert len(laspy.read(path).points) == points  # a program that knows LAZ reads it, too


@pytest.mark.parametrize("suffix", ["las", "laz", "copc.laz", "e57"])
def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path, suffix, monkeypatch):
    pytest.importorskip("laspy")
    lost: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda one: lost.append(one.exc_value))
    how = {"step_m": 0.001} if suffix != "e57" else {}
    write = {"copc.laz": write_copc, "e57": write_e57}.get(suffix, write_las)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        with pytest.raises(OutputError, match=f"cloud.{suffix}: cannot write the file"):
            write(tmp_path / f"cloud.{suffix}", [example_cloud(20_000)], np.eye(4), **how)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    gc.collect()
    assert lost == []
    assert not list(tmp_path.iterdir())


def test_a_raster_and_a_bag_on_a_full_disk_are_named(tmp_path):
    """GDAL writes the end of a raster when it is closed, and says nothing where that fails."""
    pytest.importorskip("rasterio")
    pytest.importorskip("rosbags")
    noise = np.random.default_rng(0).normal(size=(1, 256, 256)).astype(np.float32)

    def write_raster() -> None:
        place = RasterPlace(0.1, 0, 256, 256, 256)
        with write_geotiff(tmp_path / "dsm.tif", place, bands=("height",), crs=None) as file:
            file.write(0, 0, noise)

    def write_messages() -> None:
        with write_bag(tmp_path / "bag") as bag:
            bag.write("/cloud", 1, points(header("map", 1), example_cloud(20_000)))

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for name, write in (("dsm.tif", write_raster), ("bag/bag.mcap", write_messages)):
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
        try:
            with pytest.raises(OutputError, match=rf"{name}: cannot write .*disk is not full"):
                write()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
    write_raster()
    assert [path.name for path in tmp_path.glob("*.tif")] == ["dsm.tif"]


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("EPSG:99", "unknown coordinate system"),
        ("Gauss", "unknown coordinate system"),
        ("EPSG:4326", "easting and northing in metres"),  # degrees
        ("EPSG:4978", "easting and northing in metres"),  # metres, but from the centre of the earth
        ("EPSG:2263", "easting and northing in metres"),  # feet
        ("EPSG:32600", "cannot be converted.*such as EPSG:25832"),  # UTM without a zone
        ("EPSG:32700", "cannot be converted"),
    ],
)
def test_other_coordinates_are_refused(tmp_path, name, why):
    pytest.importorskip("laspy")
    with pytest.raises(SettingsError, match=why):
        write_las(tmp_path / "cloud.laz", [], np.eye(4), name)
    assert not list(tmp_path.iterdir())
    assert check_crs("EPSG:25832+7837").to_epsg(min_confidence=0) is None  # one with heights


@pytest.mark.parametrize(
    ("name", "east", "north", "inside"),
    [
        ("EPSG:25832", 456789.0, 5433210.0, True),
        ("EPSG:25832", 5433210.0, 456789.0, False),  # swapped
        ("EPSG:25832", 8.4, 49.0, False),  # degrees
        ("EPSG:3857", -1.9e7, -1.0e6, True),  # the whole world
        ("EPSG:32760", 1.0e5, 8.0e6, True),  # beside the line where dates change
        ("EPSG:3832", 3.0e6, 1.0e6, True),  # an area across that line
        ("EPSG:3832", -1.6e7, 1.0e6, False),  # Greenwich
        ("+proj=utm +zone=32 +ellps=GRS80 +units=m", 0.0, 0.0, True),  # no area is stated
    ],
)
def test_positions_lie_in_the_area_of_their_system(name, east, north, inside):
    pytest.importorskip("pyproj")
    place = np.array([east, north, 100.0])
    if inside:
        check_inside(name, place, "gnss.txt")
        return
    with pytest.raises(EvaluationError, match=r"gnss\.txt: the positions lie outside the area"):
        check_inside(name, place, "gnss.txt")


@pytest.mark.parametrize(("write", "library"), [(write_las, "laspy"), (write_e57, "pye57")])
def test_without_its_library_the_extra_is_named(tmp_path, monkeypatch, write, library):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(MissingDependencyError, match=r"recon-stereo\[survey\]"):
        write(tmp_path / "cloud", [], np.eye(4))


def test_an_e57_has_a_scan_for_each_part_at_its_place(tmp_path):
    pye57 = pytest.importorskip("pye57")
    parts, path = [example_cloud(1000), example_cloud(0), example_cloud(10)], tmp_path / "cloud.e57"
    assert write_e57(path, parts, T_SURVEY_MAP, "EPSG:25832") == 1010
    with pye57.E57(str(path)) as file:
        assert file.scan_count == 2
        assert "UTM zone 32N" in file.root["coordinateMetadata"].value()
        for number, cloud in enumerate((parts[0], parts[2])):
            found = file.read_scan(number, colors=True, ignore_missing_fields=True)
            x, y, z = cloud.xyz.astype(np.float64).T
            expected = 456789.25 - y, 5433210.5 + x, 118.75 + z
            for axis, values in zip("XYZ", expected, strict=True):
                assert np.abs(found[f"cartesian{axis}"] - values).max() < 1e-6
            rgb = np.stack([found[f"color{name}"] for name in ("Red", "Green", "Blue")], axis=1)
            np.testing.assert_array_equal(rgb, cloud.rgb)
    with pytest.raises(SettingsError, match="unknown coordinate system"):
        write_e57(path, parts, T_SURVEY_MAP, "EPSG:99")
    assert [file.name for file in tmp_path.iterdir()] == ["cloud.e57"]


def test_pcl_reads_the_points_of_a_pcd(tmp_path):
    parts, path = [example_cloud(1000), example_cloud(10)], tmp_path / "cloud.pcd"
    assert write_pcd(path, parts) == 1010
    found, cloud = open3d.t.io.read_point_cloud(str(path)).point, join_clouds(parts)
    np.testing.assert_array_equal(found["positions"].numpy(), cloud.xyz)
    np.testing.assert_array_equal(found["colors"].numpy(), cloud.rgb)
    np.testing.assert_array_equal(found["normals"].numpy(), cloud.normals)
    np.testing.assert_array_equal(found["sigma"].numpy()[:, 0], cloud.sigma_m)
    if (convert := shutil.which("pcl_pcd2ply")) is not None:
        subprocess.run([convert, path, tmp_path / "pcl.ply"], check=True, capture_output=True)
        np.testing.assert_array_equal(read_ply(tmp_path / "pcl.ply").rgb, cloud.rgb)
    assert write_pcd(path, []) == 0
    assert b"POINTS 0" in path.read_bytes()


def test_arrays_that_come_in_parts_are_one_in_an_archive(tmp_path):
    parts = [{"a": np.arange(6.0).reshape(n, 6 // n), "b": np.ones(n, np.uint8)} for n in (3, 3)]
    path = tmp_path / "map.npz"
    assert write_npz(path, iter(parts), {"whole": np.eye(4)}) == 6
    with np.load(path, allow_pickle=False) as found:
        np.testing.assert_array_equal(found["a"], np.concatenate([part["a"] for part in parts]))
        assert found["b"].dtype == np.uint8
        np.testing.assert_array_equal(found["whole"], np.eye(4))
    assert write_npz(path, [], {"whole": np.eye(4)}) == 0
    with pytest.raises(KeyError):
        write_npz(path, [parts[0], {"a": parts[0]["a"]}], {})
    assert np.load(path).files == ["whole"]  # as before
    assert [file.name for file in tmp_path.iterdir()] == ["map.npz"]


# Row 0 has the smallest y. An obstacle at the right of the lowest row, unknown at the top left.
CELLS = np.array([[FREE, FREE, FREE, OCCUPIED], [FREE] * 4, [UNKNOWN, FREE, FREE, FREE]], np.int8)
GRID = OccupancyGrid(CELLS, 0.2, (-3.4, 1.25))


def test_a_grid_is_written_as_nav2_and_a_gis_ask_and_read_back(tmp_path):
    image, description = write_nav2(tmp_path / "map" / "grid", GRID)
    assert (image.name, description.name) == ("grid.pgm", "grid.yaml")
    back = read_grid(description)
    np.testing.assert_array_equal(back.cells, GRID.cells)
    assert (back.resolution_m, back.origin_m) == (GRID.resolution_m, GRID.origin_m)
    # The first row of the image has the largest y.
    pixels = [205, 254, 254, 254, 254, 254, 254, 254, 254, 254, 254, 0]
    assert image.read_bytes() == b"P5\n4 3\n255\n" + bytes(pixels)
    assert yaml.safe_load(description.read_text()) == {
        "image": "grid.pgm", "mode": "trinary", "resolution": 0.2, "origin": [-3.4, 1.25, 0.0],
        "negate": 0, "occupied_thresh": 0.65, "free_thresh": 0.196,
    }  # fmt: skip
    x_step, y_turn, x_turn, y_step, x_m, y_m = map(
        float, image.with_suffix(".wld").read_text().split()
    )
    # Of the centre of the upper left pixel, which is the first column of the last row.
    assert (x_m, y_m) == pytest.approx((-3.4 + 0.1, 1.25 + 2.5 * 0.2))
    assert (x_step, y_turn, x_turn, y_step) == (0.2, 0, 0, -0.2)


def as_nav2_loads(description: Path, *, ends_apart: bool) -> np.ndarray:
    """Cells (rows, columns) as map_server makes them in mode ``scale``, row 0 = smallest y.

    Costs between the thresholds are 0 to 100; ``ends_apart``: 1 to 99, as other readers have it.
    Ref: loadMapFromFile in nav2_map_server/src/map_io.cpp.
    """
    fields = yaml.safe_load(description.read_text())
    assert (fields["mode"], fields["negate"]) == ("scale", 0)
    pixels = cv2.imread(str(description.parent / fields["image"]), cv2.IMREAD_UNCHANGED)
    occupancy = 1.0 - pixels[..., :3].mean(axis=2) / 255.0
    low, high = fields["free_thresh"], fields["occupied_thresh"]
    ratio = (occupancy - low) / (high - low)
    cells = np.rint(1 + 98 * ratio if ends_apart else 100 * ratio)
    cells[occupancy < low] = 0
    cells[occupancy > high] = 100
    cells[pixels[..., 3] != 255] = -1
    return cells[::-1].astype(int)


def test_costs_are_what_nav2_reads_and_the_reason_is_in_what_it_does_not_look_at(tmp_path):
    cells = np.array([[-1, -2, 0, 1], [50, 99, 100, 2]], np.int8)
    grid = OccupancyGrid(cells, 0.2, (-3.4, 1.25))
    image, description = write_nav2_costs(tmp_path / "map" / "costmap", grid)
    np.testing.assert_array_equal(
        as_nav2_loads(description, ends_apart=False), np.maximum(cells, -1)
    )
    other = as_nav2_loads(description, ends_apart=True)
    ends = (cells <= 0) | (cells == 100)
    np.testing.assert_array_equal(other[ends], np.maximum(cells, -1)[ends])
    assert other[~ends].tolist() == [2, 50, 98, 3]
    grey = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)[::-1, :, 0]
    assert grey[0, :2].tolist() == [205, 127]
    fields = yaml.safe_load(description.read_text())
    assert (fields["resolution"], fields["origin"]) == (0.2, [-3.4, 1.25, 0.0])
    assert image.with_suffix(".wld").exists()
    every = np.arange(101, dtype=np.int8)[None]
    _, path = write_nav2_costs(tmp_path / "all", OccupancyGrid(every, 0.1, (0.0, 0.0)))
    np.testing.assert_array_equal(as_nav2_loads(path, ends_apart=False), every)


def test_negated_maps_are_read_and_the_origin_is_written_as_it_is_meant(tmp_path):
    (tmp_path / "a.pgm").write_bytes(b"P5\n# made by hand\n2 1\n255\n\xff\x00")
    fields = {"image": "a.pgm", "resolution": 0.5, "origin": [0, 0, 0], "negate": 1}
    fields |= {"occupied_thresh": 0.65, "free_thresh": 0.196}
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(fields))
    assert read_grid(tmp_path / "a.yaml").cells.tolist() == [[OCCUPIED, FREE]]
    origin_m = (-646 * 0.1, 3 * 0.1)
    assert origin_m == (-64.60000000000001, 0.30000000000000004)
    _, path = write_nav2(tmp_path / "grid", OccupancyGrid(np.zeros((2, 2), np.int8), 0.1, origin_m))
    assert "-64.6\n" in path.read_text()
    assert read_grid(path).origin_m == (-64.6, 0.3)


def random_voxels(seed: int, reach: int, number: int) -> OccupancyVoxels:
    rng = np.random.default_rng(seed)
    keys = np.unique(rng.integers(-reach, reach, (number, 3)), axis=0).astype(np.int32)
    # Mostly free, and dense where the reach is small: many nodes are pruned.
    log_odds = rng.choice([-1.0, -1.0, -1.0, -1.0, -1.0, -0.3, 2.0], len(keys))
    return OccupancyVoxels(keys, log_odds.astype(np.float32), 0.2)


def by_pyoctomap(voxels: OccupancyVoxels) -> tuple[bytes, bytes]:
    """The contents of the ``.ot`` and the ``.bt`` file that OctoMap itself writes."""
    tree = pyoctomap.OcTree(voxels.resolution_m)
    tree.setClampingThresMin(1e-6)
    tree.setClampingThresMax(1.0 - 1e-6)
    cells = zip(voxels.centres_m.tolist(), voxels.log_odds.tolist(), strict=True)
    for centre, value in cells:
        tree.updateNode(centre, value, True)
    tree.updateInnerOccupancy()
    return bytes(tree.write()), bytes(tree.writeBinary())


@pytest.mark.parametrize(
    ("reach", "number"), [(5, 1), (6, 9000), (30, 20_000), (700, 3000), (KEY_LIMIT, 500)]
)
def test_files_are_those_of_octomap_byte_for_byte_and_keep_every_cell(tmp_path, reach, number):
    voxels = random_voxels(reach, reach, number)
    binary, full = write_octomap(tmp_path / "map", voxels)
    assert (full.read_bytes(), binary.read_bytes()) == by_pyoctomap(voxels)
    back = read_octomap(full)
    assert back.resolution_m == 0.2
    ours, theirs = (np.lexsort(each.keys.T) for each in (voxels, back))
    np.testing.assert_array_equal(voxels.keys[ours], back.keys[theirs])
    np.testing.assert_array_equal(voxels.log_odds[ours], back.log_odds[theirs])


@pytest.mark.parametrize("depth", [1, 3, 6, 11])
def test_a_map_in_tiles_gives_the_same_files(tmp_path, depth):
    voxels = random_voxels(2, 40, 6000)
    write_octomap(tmp_path / "whole", voxels)
    tile = voxels.keys[:, :2] >> depth
    tiles = [
        OccupancyVoxels(voxels.keys[inside], voxels.log_odds[inside], 0.2)
        for column in np.unique(tile, axis=0)
        for inside in [(tile == column).all(axis=1)]
    ]
    write_octomap_tiles(tmp_path / "tiled", tiles[::-1], depth, 0.2)
    for end in ("bt", "ot"):
        tiled, whole = (tmp_path / f"{name}.{end}" for name in ("tiled", "whole"))
        assert tiled.read_bytes() == whole.read_bytes()


@pytest.mark.parametrize("cell", [-KEY_LIMIT - 1, KEY_LIMIT])
def test_a_map_too_large_for_octomap_is_refused(tmp_path, cell):
    voxels = OccupancyVoxels(np.array([[0, cell, 0]], np.int32), np.ones(1, np.float32), 0.2)
    with pytest.raises(MappingError, match="too large"):
        write_octomap(tmp_path / "map", voxels)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("nodes_each", [1, 7, 1000, 10**9])
def test_a_file_is_read_in_pieces_in_its_order(tmp_path, nodes_each):
    _, full = write_octomap(tmp_path / "map", random_voxels(3, 8, 2000))
    whole, pieces = read_octomap(full), list(octomap_pieces(full, nodes_each))
    assert len(pieces) > 1 or nodes_each == 10**9
    assert {piece.resolution_m for piece in pieces} == {0.2}
    for name in ("keys", "log_odds"):
        joined = np.concatenate([getattr(piece, name) for piece in pieces])
        np.testing.assert_array_equal(joined, getattr(whole, name))


def test_a_piece_takes_memory_for_its_cells_alone(tmp_path):
    _, full = write_octomap(tmp_path / "map", random_voxels(5, 60, 200_000))
    cells = sum(len(piece) for piece in octomap_pieces(full, 1000))  # compiles the kernel
    tracemalloc.start()
    assert sum(len(piece) for piece in octomap_pieces(full, 1000)) == cells > 180_000
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # A cell is 16 bytes: the whole would be 3 MB, and twice that while it is made.
    assert peak_bytes < 3e5


def test_pruned_leaves_of_octomaps_own_files_are_expanded(tmp_path):
    keys = np.stack(np.unravel_index(np.arange(12**3), (12, 12, 12)), axis=1) - 4
    tree = pyoctomap.OcTree(0.2)
    for centre in ((keys + 0.5) * 0.2).tolist():
        tree.updateNode(centre, 1.5)  # leaves that have become alike are pruned at once
    pruned = bytes(tree.write())
    assert pruned.count(np.float32(1.5).tobytes()) < len(keys) / 2
    (tmp_path / "pruned.ot").write_bytes(pruned)
    back = read_octomap(tmp_path / "pruned.ot")
    assert sorted(back.keys.tolist()) == sorted(keys.tolist())
    np.testing.assert_array_equal(back.log_odds, np.float32(1.5))


@pytest.mark.parametrize(
    "kind", ["cut", "no tree", "more nodes", "leaf near the root", "not a number", "another tree"]
)
def test_a_damaged_ot_file_is_a_format_error(tmp_path, kind):
    _, full = write_octomap(tmp_path / "map", random_voxels(4, 30, 3000))
    content = full.read_bytes()
    head, data, nodes = content.partition(b"data\n")
    size = head[head.index(b"size ") :].split(b"\n")[0]
    more = b"size %d" % (int(size.split()[1]) + 1)
    damaged = {
        "cut": content[:-3],
        "no tree": head,
        "more nodes": content.replace(size, more) + bytes(5),
        "leaf near the root": head + data + nodes[:4] + b"\0" + nodes[5:],
        "not a number": content[:-5] + np.float32(np.nan).tobytes() + content[-1:],
        "another tree": content.replace(b"id OcTree", b"id ColorOcTree"),
    }
    full.write_bytes(damaged[kind])
    words = "ColorOcTree" if kind == "another tree" else "truncated or damaged"
    with pytest.raises(FormatError, match=words):
        read_octomap(full)

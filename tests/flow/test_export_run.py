"""Products of a finished run are made again, by other settings too, and compared with the truth."""

import contextlib
import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from recon.commands.config import PAIR_DEFAULTS, load_config, run_settings
from recon.commands.demo import demo_source
from recon.commands.evaluate import run_evaluate_occupancy
from recon.commands.export import run_export, run_mesh, run_occupancy
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.commands.pair import run_pair
from recon.core.errors import EvaluationError, FormatError, ReconError, SettingsError
from recon.core.geometry.se3 import apply, exp_so3, make_transform
from recon.core.values import OCCUPIED, RectifiedCamera, StereoPair
from recon.export.mesh import pieces
from recon.io.models.mesh import read_mesh
from recon.io.models.octomap import read_octomap
from recon.io.models.ply import read_ply
from recon.io.models.rasters import read_grid
from recon.io.trajectory import read_tum
from recon.map.store.records import Store
from recon.report.style import GRID_ERRORS, GRID_NOT_COUNTED
from recon.run.batch.cluster import BatchOptions, Cluster
from recon.sources.one_pair import PairInput
from recon.stereo import observe
from tests.flow.runs import summary_of
from tests.hostile.refusals import assert_refused, run

MAPS = ("map/grid.pgm", "map/grid.yaml", "map/octomap.bt", "map/octomap.ot")


def assert_equal(one: Path, other: Path, *names: str) -> None:
    for name in names:
        assert (one / name).read_bytes() == (other / name).read_bytes(), name


def test_all_products_come_in_one_go_and_nothing_is_matched(small_demo, tmp_path, monkeypatch):
    monkeypatch.delattr(observe, "make_matcher")
    config = run_settings(small_demo, None, ["mesh.depth=5", "mesh.min_component_faces=10"])
    summary = run_export(small_demo, config, formats=("ply", "glb"), out=tmp_path / "out").to_json()
    assert_equal(tmp_path / "out", small_demo, "map/cloud.ply", *MAPS)
    assert len(read_mesh(tmp_path / "out/mesh/mesh.glb").faces) == summary["faces"] > 100
    assert summary["points"] == len(read_ply(small_demo / "map/cloud.ply"))
    assert {"voxels", "occupied_cells", "camera_height_m", "tiles", "frames"} <= set(summary)
    record = json.loads((tmp_path / "out/run.json").read_text())
    assert record["command"] == "export"
    assert "map/octomap.ot" in record["files"]
    np.testing.assert_array_equal(record["T_map_world"], summary["T_map_world"])


def test_products_whose_tiles_workers_make_are_the_same_files(small_demo, tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None
        ) as local,
        distributed.Client(local) as client,
    ):
        there = contextlib.nullcontext(Cluster(client))
        monkeypatch.setattr(BatchOptions, "connect", lambda options: there)
        products, out = ["grid", "octomap"], tmp_path / "out"
        run_export(small_demo, products=products, out=out, workers=BatchOptions(workers=2))
    assert_equal(out, small_demo, *MAPS)
    files = sorted(p.name for p in out.rglob("*") if p.is_file())
    maps = [Path(name).name for name in MAPS]
    assert files == sorted([*maps, "grid.wld", "config.yaml", "run.json", "summary.json"])


def test_the_cloud_comes_as_laz_and_e57_in_survey_coordinates_and_as_arrays(small_demo, tmp_path):
    laspy = pytest.importorskip("laspy")
    path, origin = read_tum(small_demo / "trajectory_map_base_tum.txt"), np.array([4e5, 5e6, 100])
    there = np.column_stack([path.timestamps_s, path.positions_m + origin])
    np.savetxt(tmp_path / "gnss.txt", there, fmt="%.6f")
    height_m = summary_of(small_demo)["camera_height_m"]
    words = ["--georeference", tmp_path / "gnss.txt", f"--antenna=0,0,{-height_m}"]
    out = tmp_path / "out"
    words += ["--crs", "EPSG:25832", "--out", out]
    done = run("export", small_demo, "--to", "laz,e57,npz", *words)
    assert done.code == 0, done.err
    found, cloud = laspy.read(out / "map/cloud.laz"), read_ply(small_demo / "map/cloud.ply")
    expected = cloud.xyz.astype(np.float64) + origin
    assert np.abs(found.xyz - expected).max() < 0.002
    assert found.header.parse_crs().to_epsg() == 25832
    assert summary_of(out)["misfit_rms_m"] < 0.001
    # 2 is ground, which is a plane here but for kerbs; 64 is what stands on it, 1 is not known.
    assert set(found.classification) <= {1, 2, 64}
    ground = np.asarray(found.classification) == 2
    level = np.column_stack([cloud.xyz[:, :2], np.ones(len(cloud))]).astype(np.float64)
    plane = np.linalg.lstsq(level[ground], cloud.xyz[ground, 2], rcond=None)[0]
    above_m = cloud.xyz[:, 2] - level @ plane
    assert np.abs(above_m[ground]).max() < 0.3
    assert (np.asarray(found.classification)[above_m > 0.5] == 64).mean() > 0.9
    assert ground[np.abs(above_m) < 0.02].mean() > 0.8
    with pytest.importorskip("pye57").E57(str(out / "map/cloud.e57")) as file:
        scans = [file.read_scan(n, colors=True) for n in range(file.scan_count)]
        heights = np.concatenate([scan["cartesianZ"] for scan in scans])
    assert np.abs(heights - expected[:, 2]).max() < 0.002
    with np.load(out / "map/map.npz") as arrays:
        np.testing.assert_array_equal(arrays["xyz"], cloud.xyz)
        np.testing.assert_array_equal(arrays["sigma_m"], cloud.sigma_m)
        np.testing.assert_allclose(arrays["times_s"], path.timestamps_s)
        T_map_world = np.array(summary_of(small_demo)["T_map_world"])
        camera = read_tum(small_demo / "trajectory_tum.txt").T_world_camera
        np.testing.assert_allclose(arrays["T_map_camera"], T_map_world @ camera, atol=1e-6)
        assert arrays["placed"].all()


def test_what_is_odd_in_a_survey_is_said_once_for_all_its_products(small_demo, tmp_path):
    path = read_tum(small_demo / "trajectory_map_base_tum.txt")
    there = np.column_stack([path.timestamps_s, path.positions_m])
    there[len(there) // 2, 1:] += 50.0
    np.savetxt(tmp_path / "gnss.txt", there, fmt="%.6f")
    words = ["--to", "laz,npz,pcd,dsm,dtm,slope", "--out", tmp_path / "out"]
    done = run("export", small_demo, "--georeference", tmp_path / "gnss.txt", *words)
    assert done.code == 0, done.err
    found = summary_of(tmp_path / "out")
    left_out = [line for line in found["warnings"] if "left out" in line]
    assert len(left_out) == found["positions_left_out"] == 1, found["warnings"]
    assert done.err.count(left_out[0][:30]) == 1


def test_a_mesh_of_a_survey_lies_at_its_place_from_the_offset_beside_it(small_demo, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    path, origin = read_tum(small_demo / "trajectory_map_base_tum.txt"), np.array([4e5, 5e6, 100])
    turn = make_transform(exp_so3(np.array([0.0, 0.0, 0.5])), origin + 34.5)
    there = np.column_stack([path.timestamps_s, apply(turn, path.positions_m)])
    np.savetxt(tmp_path / "gnss.txt", there, fmt="%.6f")
    height_m, out = summary_of(small_demo)["camera_height_m"], tmp_path / "out"
    words = ["--georeference", tmp_path / "gnss.txt", f"--antenna=0,0,{-height_m}", "--out", out]
    words += ["--crs", "EPSG:25832", "--format", "ply,obj"]
    done = run("export", small_demo, "--to", "mesh,texture", *words)
    assert done.code == 0, done.err
    ours = read_mesh(out / "mesh/mesh.ply")
    expected = apply(turn, ours.vertices.astype(np.float64))
    for folder, count in (("mesh", len(expected)), ("texture", None)):
        offset_m = np.loadtxt(out / folder / "survey/offset.xyz")
        assert (offset_m % 100 == 0).all()
        assert offset_m.tolist() == summary_of(out)["mesh_offset_m"]
        assert "ETRS_1989_UTM_Zone_32N" in (out / folder / "survey/mesh.prj").read_text()
        for suffix in ("ply", "obj"):
            found = trimesh.load(out / folder / f"survey/mesh.{suffix}", process=False)
            places = np.asarray(found.vertices) + offset_m
            if count is None:  # charts share vertices
                off_m, _ = cKDTree(expected).query(places)
                assert off_m.max() < 0.001
            else:
                assert np.abs(places - expected).max() < 0.001
    assert (out / "texture/survey/mesh.mtl").is_file()


def test_rasters_show_the_map_from_above_where_the_survey_says(small_demo, tmp_path):
    rasterio = pytest.importorskip("rasterio")
    path, turn = read_tum(small_demo / "trajectory_map_base_tum.txt"), np.radians(30)
    R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    origin, height_m = np.array([4e5, 5e6, 100]), summary_of(small_demo)["camera_height_m"]
    there = np.column_stack([path.timestamps_s, path.positions_m @ R.T + origin])
    np.savetxt(tmp_path / "gnss.txt", there, fmt="%.6f")
    words = ["--georeference", tmp_path / "gnss.txt", f"--antenna=0,0,{-height_m}"]
    out = tmp_path / "out"
    words += ["--crs", "EPSG:25832", "--out", out]
    done = run("export", small_demo, "--to", "dsm,dtm,slope,orthophoto,grid-geotiff", *words)
    assert done.code == 0, done.err
    cloud = read_ply(small_demo / "map/cloud.ply")
    xyz = np.einsum("ij,nj->ni", R, cloud.xyz.astype(np.float64)) + origin

    def at_points(name, band=1, places=xyz):
        with rasterio.open(out / f"map/{name}.tif") as file:
            assert file.crs.to_epsg() == 25832
            row, column = rasterio.transform.rowcol(file.transform, *places[:, :2].T)
            return file.read(band)[row, column]

    for name in ("dsm", "dtm", "slope", "grid"):
        with rasterio.open(out / f"map/{name}.tif") as file:
            assert np.isnan(file.nodata)
            assert not np.isinf(file.read(1)).any()
            assert np.isnan(file.read(1)).any() == (name == "grid")  # ground goes on
    # A point in the survey may be rounded into the next cell.
    assert np.mean(at_points("dsm") >= xyz[:, 2] - 1e-3) > 0.98
    highest = np.abs(at_points("dsm") - xyz[:, 2]) < 1e-3
    assert 0.1 < highest.mean() < 1
    seen = at_points("orthophoto", 4) == 255
    assert seen.mean() > 0.7
    with rasterio.open(out / "map/orthophoto.tif") as file:  # else GIS draw what is unknown black
        assert file.colorinterp[3] == rasterio.enums.ColorInterp.alpha
        assert file.res[0] == summary_of(out)["gsd_m"] < 0.2
    off = at_points("orthophoto").astype(float) - cloud.rgb[:, 0]
    assert np.median(np.abs(off[seen & highest])) < 10
    assert np.abs(np.mean(off[seen & highest])) < 5
    # The base is driven over the ground, from where it is seen on; the rendered street is level.
    ahead = there[-1, 1:] - there[0, 1:]
    driven = there[-2:, 1:] + 8.0 * ahead / np.linalg.norm(ahead)
    assert np.abs(at_points("dtm", places=driven) - driven[:, 2]).max() < 0.1
    assert np.nanmedian(at_points("slope")) < 3
    assert (at_points("grid", places=driven) == 0).all()
    grid = read_grid(small_demo / "map/grid.yaml")
    i, j = np.argwhere(grid.cells == OCCUPIED).T
    xy_m = grid.origin_m + grid.resolution_m * (np.column_stack([j, i]) + 0.5)
    placed = np.column_stack([xy_m, np.zeros(len(i))]) @ R.T + origin
    inside = (placed[:, :2] > xyz[:, :2].min(0)) & (placed[:, :2] < xyz[:, :2].max(0))
    found = at_points("grid", places=placed[inside.all(axis=1)])
    # A turned cell has the middle of another one: some at the edge of what stands are free.
    assert found.size > 100
    assert np.mean(found == OCCUPIED) > 0.7


def test_rasters_say_which_cells_points_show_and_are_read_from_afar(small_demo, tmp_path):
    rasterio, out = pytest.importorskip("rasterio"), tmp_path / "out"
    assert run("export", small_demo, "--to", "dsm,dtm,slope,grid-geotiff", "--out", out).code == 0
    found = {}
    for name, unit in (
        ("dsm", "metre"),
        ("dtm", "metre"),
        ("slope", "degree"),
        ("grid", "percent"),
    ):
        with rasterio.open(out / f"map/{name}.tif") as file:
            assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert file.units[0] == unit
            names = {"grid": ("occupied",), "slope": ("slope", "measured")}
            assert file.descriptions == names.get(name, ("height", "measured"))
            found[name] = file.read()
            place = file.transform
    (surface, shown), (ground, known) = found["dsm"], found["dtm"]
    # The surface has the extent of the ground, and is the ground where no point lies.
    assert not np.isnan(surface[~np.isnan(ground)]).any()
    np.testing.assert_array_equal(surface[shown == 0], ground[shown == 0])
    assert 0.05 < (shown == 0).mean() < 0.95
    xyz = read_ply(small_demo / "map/cloud.ply").xyz
    row, column = rasterio.transform.rowcol(place, *xyz[:, :2].astype(np.float64).T)
    assert (shown[row, column] == 1).mean() > 0.99  # but for one at the edge of a cell
    assert shown.sum() <= len(xyz)
    # Cells of the ground, a metre wide, have some points or are carried over from others.
    assert {*np.unique(known[~np.isnan(ground)])} == {0.0, 1.0}
    assert (known[(shown == 1) & (surface - ground < 0.05)] == 1).mean() > 0.9


@pytest.mark.parametrize(("options", "said"), [
    ("laz --crs EPSG:25832", "--crs: there are no positions"),
    ("laz --georeference none.txt --antenna 1,2", "not three numbers"),
    ("grid --georeference none.txt", "no product has the coordinates"),
    ("laz --georeference none.txt --crs EPSG:4326", "easting and northing in metres"),
    ("laz --georeference none.txt", "none.txt"),
    ("cloud,gird", "--to: unknown product (got gird, expected cloud, octomap, grid"),
    ("mesh --format step", "unknown mesh format (got step"),
    ("grid --set fusion.min_count=1", "no effect here"),
    ("grid --heights 0.1-2", "--heights: not bands of heights (got 0.1-2, expected 0.1:0.5,"),
    ("grid --heights 0.1:0.5:2", "--heights: not bands of heights"),
    ("grid --heights 0.1:", "not bands of heights"),
    ("grid --heights nan:1", "grid.heights_m"),
    ("grid --heights 2:0.5", "height band of the grid is empty (got 2 to 0.5 m)"),
    ("mesh --workers 2", "only grids and OctoMaps"),
])  # fmt: skip
def test_what_cannot_be_asked_for_is_one_line(small_demo, tmp_path, options, said):
    if "EPSG:4326" in options:
        pytest.importorskip("pyproj")
    words = ("--to", *options.split(), "--out", tmp_path / "out")
    assert_refused(run("export", small_demo, *words), said)
    assert not (tmp_path / "out").exists()


@pytest.fixture
def without_rays(small_demo, tmp_path):
    run = Path(shutil.copytree(small_demo, tmp_path / "run"))
    with Store.open(run / "map/map.recon") as store:
        store.delete("rays")
        store.commit()
    return run


def test_what_is_not_there_is_told(without_rays, tmp_path):
    summary = run_export(without_rays, products=["cloud"], out=tmp_path / "out").to_json()
    assert summary["points"] > 1000
    other = tmp_path / "other"
    with pytest.raises(FormatError, match=r"kept no rays to build occupancy from.*keep_rays=true"):
        run_export(without_rays, products=["grid"], out=other)
    (without_rays / "map/map.recon").unlink()
    with pytest.raises(FormatError, match=r"folder has no map \(expected a map/map\.recon"):
        run_export(without_rays, products=["cloud"], out=other)
    (without_rays / "run.json").write_text('{"command": "calibrate"}')
    with pytest.raises(FormatError, match="made no map"):
        run_export(without_rays, out=other)
    with pytest.raises(FormatError, match="not contain a finished run"):
        run_export(tmp_path / "nothing", out=other)
    assert not other.exists()


@pytest.mark.parametrize("make", [run_export, run_mesh, run_occupancy])
def test_the_run_itself_is_never_replaced(small_demo, make):
    with pytest.raises(SettingsError, match="replace the run"):
        make(small_demo, run_settings(small_demo, None, []), out=small_demo)


def test_a_pair_gives_its_cloud_and_mesh_and_no_grid(tmp_path):
    noise = np.random.default_rng(3).integers(0, 256, (120, 180)).astype(np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5)
    world = np.asarray(cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX), np.uint8)
    pair = StereoPair(world[:, :160], world[:, 12:172], name="left.png")
    camera, run = RectifiedCamera(150.0, 80.0, 60.0, 80.0, 0.1, 160, 120), tmp_path / "run"
    shallow = ["mesh.depth=5"]
    run_pair(PairInput(pair, camera), load_config(None, shallow, PAIR_DEFAULTS), out=run)
    config = run_settings(run, None, shallow)
    summary = run_export(run, config, formats=("ply", "glb"), out=tmp_path / "out").to_json()
    assert_equal(tmp_path / "out", run, "clouds/cloud.ply")
    assert len(read_mesh(tmp_path / "out/mesh/mesh.glb").faces) == summary["faces"]
    assert summary["mesh_coverage"] == 1.0
    with pytest.raises(SettingsError, match=r"a pair has no such product .*grid.*cloud, mesh"):
        run_export(run, load_config(), products=["grid"], out=tmp_path / "out")


def mesh_of(run: Path, out: Path, *settings: str) -> dict[str, Any]:
    # What is written is asked, not how fine it is.
    config = load_config(None, ["mesh.tile_m=10", "mesh.depth=5", *settings])
    return run_mesh(run, config, out=out, formats=("ply", "glb")).to_json()


def layers(out: Path) -> list[str]:
    return re.findall(r'filename="(.*?)"', (out / "mesh/mesh.mlp").read_text())


def test_the_map_of_a_run_is_meshed_in_pieces(small_demo, tmp_path):
    summary = mesh_of(small_demo, tmp_path)
    assert summary["tiles"] >= 2
    assert not [text for text in summary["warnings"] if "free space" in text]
    assert len(read_mesh(tmp_path / "mesh/mesh.glb").faces) == summary["faces"] > 100
    assert len(layers(tmp_path)) == summary["tiles"] + 1
    assert all((tmp_path / "mesh" / layer).is_file() for layer in layers(tmp_path))
    cloud = small_demo / "map/cloud.ply"
    assert (tmp_path / "mesh/cloud.ply").read_bytes() == cloud.read_bytes()
    assert summary["points"] == len(read_ply(cloud))


def test_one_piece_is_the_mesh_itself_without_the_faces_in_free_space(
    small_demo, without_rays, tmp_path, monkeypatch
):
    # Poisson's surface goes on into space; that of the voxels does so where something moved.
    one, out = ("mesh.tile_m=1000", "mesh.surface=poisson"), tmp_path / "cut"
    cut = mesh_of(small_demo, out, *one)
    assert cut["tiles"] == 1
    assert layers(out) == ["mesh.ply", "cloud.ply"]
    files = sorted(p.name for p in (out / "mesh").iterdir() if p.is_file())
    assert files == ["cloud.ply", "mesh.glb", "mesh.mlp", "mesh.ply"]
    with monkeypatch.context() as patched:
        patched.setattr(pieces, "looked_through", lambda xyz, voxels: np.zeros(len(xyz), np.bool_))
        kept = mesh_of(small_demo, tmp_path / "kept", *one)
    assert kept["faces"] > cut["faces"] > 100
    [*_, warning] = mesh_of(without_rays, tmp_path / "unknown", *one)["warnings"]
    assert "free space is not known" in warning


def _remake(run: Path, out: Path, *overrides: str) -> dict[str, Any]:
    return run_occupancy(run, run_settings(run, None, overrides), out=out).to_json()


@pytest.fixture
def copy(small_demo, tmp_path):
    return Path(shutil.copytree(small_demo, tmp_path / "copy"))


def test_another_height_band_changes_the_grid_alone(small_demo, tmp_path):
    out = tmp_path / "high"
    _remake(small_demo, out, "grid.min_height_m=2.2", "grid.max_height_m=6")
    same = "map/octomap.bt"
    assert (out / same).read_bytes() == (small_demo / same).read_bytes()
    low, high = (read_grid(f / "map/grid.yaml") for f in (small_demo, out))
    assert low.cells.shape == high.cells.shape
    parked = (low.cells == OCCUPIED) & (high.cells != OCCUPIED)
    assert parked.sum() > 10  # cars are lower than the band


def test_bands_of_heights_have_grids_of_their_own_from_one_command(small_demo, tmp_path):
    out = tmp_path / "bands"
    words = ("--to", "grid", "--heights", "0.3:0.8,2.2:6", "--out", out, "--json")
    assert run("export", small_demo, *words).code == 0
    assert_equal(out, small_demo, "map/grid.yaml", "map/grid.pgm")
    for low, high in (("0.3", "0.8"), ("2.2", "6")):
        _remake(small_demo, tmp_path / low, f"grid.min_height_m={low}", f"grid.max_height_m={high}")
        alone = read_grid(tmp_path / low / "map/grid.yaml")
        band = read_grid(out / f"map/grid_{low}-{high}m.yaml")
        np.testing.assert_array_equal(band.cells, alone.cells)
        assert (band.resolution_m, band.origin_m) == (alone.resolution_m, alone.origin_m)
    record = json.loads((out / "run.json").read_text())
    assert "map/grid_2.2-6m.wld" in record["files"]
    # The settings of the run say it, too.
    kept = run_settings(out)
    assert kept.grid.heights_m == ((0.3, 0.8), (2.2, 6.0))


# Few small images: what was measured is 0.96 and 0.53, 0.91 and 0.96. At 0.1 m neighbouring rays
# end farther apart than voxels, so that recall is low.
@pytest.mark.parametrize(
    ("resolution_m", "precision", "recall"), [(0.1, 0.9, 0.4), (0.5, 0.85, 0.9)]
)
def test_another_resolution_is_right_too(small_demo, tmp_path, resolution_m, precision, recall):
    out = tmp_path / "out"
    summary = _remake(small_demo, out, f"occupancy.resolution_m={resolution_m}")
    grid, voxels = read_grid(out / "map/grid.yaml"), read_octomap(out / "map/octomap.ot")
    found = run_evaluate_occupancy(out).metrics
    sizes_m = {summary["resolution_m"], grid.resolution_m, voxels.resolution_m, found.resolution_m}
    assert sizes_m == {resolution_m}
    assert found.voxels.precision > precision
    assert found.voxels.recall > recall


@pytest.mark.parametrize(("setting", "words"), [
    (
        "occupancy.resolution_m=0.09",
        r"too coarse for these.*got 0\.09 m, expected at least 0\.1",
    ),
    ("occupancy.max_range_m=26", r"that far \(got 26 m, expected at most 25 m"),
    ("matching.matcher=sgm", "has no effect here.*matching"),
    ("grid.min_height_m=7", "height band"),
])  # fmt: skip
def test_what_the_rays_do_not_hold_is_refused(small_demo, tmp_path, setting, words):
    with pytest.raises(ReconError, match=words):
        _remake(small_demo, tmp_path / "out", setting)
    assert not (tmp_path / "out").exists()


def test_rays_and_poses_must_be_of_the_same_frames(copy, tmp_path):
    with Store.open(copy / "map/map.recon") as store:
        store.delete("rays", (0, 11))
        store.commit()
    with pytest.raises(FormatError, match="11 and 12"):
        _remake(copy, tmp_path / "out")


def test_the_command_prints_json_and_says_what_is_wrong(small_demo, tmp_path):
    out = tmp_path / "out"
    command = ("occupancy", small_demo, "--out", out)
    good = run(*command, "--json", "--resolution", "0.5", "--min-height", "0.5")
    assert good.code == 0, good.err
    assert json.loads(good.out) == summary_of(out)
    record = json.loads((out / "run.json").read_text())
    assert (record["command"], record["mapped_by"]) == ("occupancy", "demo")
    files = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    assert set(record["files"]) == files
    assert_refused(run(*command, "--resolution", "0.01"))
    assert summary_of(out)["resolution_m"] == 0.5  # the earlier result stays


def test_a_run_gives_its_figures_and_a_drawing_of_errors(small_demo, tmp_path):
    image = tmp_path / "compared.png"
    done = run("evaluate", "occupancy", small_demo, "--json", "--picture", image)
    assert done.code == 0, done.err
    printed = json.loads(done.out)
    assert printed == {**summary_of(small_demo)["occupancy"], "warnings": []}
    assert 0 < printed["voxels"]["precision"] < 1
    few, many = (run_evaluate_occupancy(small_demo, least).metrics for least in (1, 6))
    assert few.voxels.true_voxels > many.voxels.true_voxels > 0
    assert many.least_frames == 6

    colours = cv2.imread(str(image))[..., ::-1].reshape(-1, 3)
    counts = {kind: int((colours == rgb).all(axis=1).sum()) for kind, rgb in GRID_ERRORS.items()}
    # A cell is a square of pixels.
    side_px = math.isqrt(sum(counts.values()) // printed["grid"]["cells"])
    counts = {kind: pixels / side_px**2 for kind, pixels in counts.items()}
    assert sum(counts.values()) == printed["grid"]["cells"]
    true = sum(n for (kind, _), n in counts.items() if kind == 100)
    assert true == printed["grid"]["true_occupied"]
    unknown = sum(n for (_, kind), n in counts.items() if kind == -1)
    assert unknown / printed["grid"]["cells"] == pytest.approx(printed["grid"]["unknown"])
    assert (colours == GRID_NOT_COUNTED).all(axis=1).any()


def test_what_cannot_be_compared_with_its_truth_is_refused(copy):
    for lost in ("map/octomap.ot", "map/grid.pgm"):
        (copy / lost).rename(copy / "lost")
        with pytest.raises(FormatError, match=rf"{lost}: file does not exist"):
            run_evaluate_occupancy(copy)
        (copy / "lost").rename(copy / lost)
    record = json.loads((copy / "run.json").read_text())
    (copy / "run.json").write_text(json.dumps({**record, "command": "map"}))
    with pytest.raises(EvaluationError, match=r"not known.*recon map.*evaluate map"):
        run_evaluate_occupancy(copy)


def test_grids_that_others_drew_larger_are_compared_too(small_demo, copy):
    grid = read_grid(copy / "map" / "grid.yaml")
    rows, columns = grid.cells.shape
    image = np.full((rows + 7, columns + 5), 205, np.uint8)
    original = cv2.imread(str(copy / "map" / "grid.pgm"), cv2.IMREAD_GRAYSCALE)
    image[7:, 5:] = original  # row 0 is the top: the origin moves left, and not down
    cv2.imwrite(str(copy / "map" / "grid.pgm"), image)
    text, x = (copy / "map" / "grid.yaml").read_text(), grid.origin_m[0]
    assert f"- {x}" in text
    (copy / "map" / "grid.yaml").write_text(text.replace(f"- {x}", f"- {x - 5 * 0.2}", 1))
    assert run_evaluate_occupancy(copy).metrics == run_evaluate_occupancy(small_demo).metrics


STREETS = {
    "curve": ["street.seed=1"],
    "another": ["street.seed=3"],
    "straight": ["street.seed=5", "street.path=straight"],
}


@pytest.mark.slow
@pytest.mark.parametrize("street", STREETS)
def test_occupied_and_free_are_where_they_really_are(street, tmp_path):
    config = load_config(None, ["street.frames=30", *STREETS[street]])
    options = MapOptions(audit=False, out=tmp_path / "run", mesh=False)
    mapped = run_map(demo_source(config), config, options)
    found = mapped.errors.occupancy
    assert mapped.summary.to_json()["occupancy"]["voxels"]["recall"] == found.voxels.recall
    # What is asked for, seen at least three times; measured 0.94 to 0.96, and 0.98.
    assert found.voxels.precision >= 0.9
    assert found.voxels.recall >= 0.9
    # Within one cell; the very cell gives 0.65 to 0.71.
    assert 0.8 <= found.grid.iou_occupied < 1
    # The very cell.
    assert 0.95 <= found.grid_exact.iou_free < 1
    assert found.grid.occupied_called_free < 0.05


def test_the_volume_of_a_run_above_a_plane(small_demo):
    done = run("volume", small_demo, "--height=-5", "--within", "4,-1,8,1", "--json")
    assert done.code == 0, done.err
    found = json.loads(done.out)
    area = found["compared_m2"] + found["not_compared_m2"]
    assert area == pytest.approx(8.0)
    # A road 1.65 m below the camera.
    assert found["net_m3"] / found["compared_m2"] == pytest.approx(3.35, abs=0.2)
    assert 0 < found["sigma_m3"] < 0.5
    for words, said in (
        (["--height=1", small_demo], "nothing to compare"),
        ([], "nothing to compare"),
        (["--height=1", "--within", "1,2,3"], "not a rectangle"),
        (["--height=1", "--within", "3,0,1,2"], "not a rectangle"),
    ):
        assert_refused(run("volume", small_demo, *words), said)

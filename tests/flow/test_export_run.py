"""`recon export` makes any product of a finished run again."""

from __future__ import annotations

import contextlib
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.commands.config import PAIR_DEFAULTS, load_config, run_settings
from recon.commands.export import run_export
from recon.commands.pair import run_pair
from recon.core.errors import FormatError, SettingsError
from recon.core.values import OCCUPIED, RectifiedCamera, StereoPair
from recon.io.models.mesh import read_mesh
from recon.io.models.nav2 import read_nav2
from recon.io.models.ply import read_ply
from recon.io.trajectory import read_tum
from recon.map.store.records import Store
from recon.run.batch.cluster import BatchOptions, Cluster
from recon.sources.one_pair import PairInput
from tests.hostile.refusals import assert_refused, run


@pytest.fixture(scope="module")
def pair_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of a pair that sees a plane of blurred noise."""
    noise = np.random.default_rng(3).integers(0, 256, (120, 180)).astype(np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5)
    world = np.asarray(cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX), np.uint8)
    pair = StereoPair(world[:, :160], world[:, 12:172], name="left.png")
    camera = RectifiedCamera(150.0, 80.0, 60.0, 80.0, 0.1, 160, 120)
    out = tmp_path_factory.mktemp("pair") / "run"
    config = load_config(None, ["mesh.max_depth=5"], PAIR_DEFAULTS)
    run_pair(PairInput(pair, camera), config, out=out)
    return out


def test_all_products_come_in_one_go(small_demo: Path, tmp_path: Path) -> None:
    config = run_settings(small_demo, None, ["mesh.depth=5", "mesh.min_component_faces=10"])
    summary = run_export(small_demo, config, formats=("ply", "glb"), out=tmp_path / "out")
    for name in ("map/cloud.ply", "map/grid.pgm", "map/grid.yaml", "map/octomap.bt"):
        assert (tmp_path / "out" / name).read_bytes() == (small_demo / name).read_bytes()
    assert len(read_mesh(tmp_path / "out/mesh/mesh.glb").faces) == summary["faces"] > 100
    assert summary["points"] == len(read_ply(small_demo / "map/cloud.ply"))
    assert {"voxels", "occupied_cells", "camera_height_m", "tiles", "frames"} <= set(summary)
    record = json.loads((tmp_path / "out/run.json").read_text())
    assert record["command"] == "export"
    assert "map/octomap.ot" in record["files"]
    np.testing.assert_array_equal(record["T_map_world"], summary["T_map_world"])


def test_products_whose_tiles_workers_make_are_the_same_files(
    small_demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    for name in ("map/grid.pgm", "map/grid.yaml", "map/octomap.bt", "map/octomap.ot"):
        assert (out / name).read_bytes() == (small_demo / name).read_bytes()
    assert not (out / ".partial").exists()


def test_the_cloud_comes_as_laz_in_the_coordinates_of_a_survey(
    small_demo: Path, tmp_path: Path
) -> None:
    laspy = pytest.importorskip("laspy")
    path, origin = read_tum(small_demo / "trajectory_map_base_tum.txt"), np.array([4e5, 5e6, 100])
    there = np.column_stack([path.timestamps_s, path.positions_m + origin])
    np.savetxt(tmp_path / "gnss.txt", there, fmt="%.6f")
    height_m = json.loads((small_demo / "summary.json").read_text())["camera_height_m"]
    words = ["--georeference", tmp_path / "gnss.txt", f"--antenna=0,0,{-height_m}"]
    out = tmp_path / "out"
    done = run("export", small_demo, "--to", "laz", *words, "--crs", "EPSG:25832", "--out", out)
    assert done.code == 0, done.err
    found, cloud = laspy.read(out / "map/cloud.laz"), read_ply(small_demo / "map/cloud.ply")
    expected = cloud.xyz.astype(np.float64) + origin
    assert np.abs(found.xyz - expected).max() < 0.002
    assert found.header.parse_crs().to_epsg() == 25832
    summary = json.loads((out / "summary.json").read_text())
    assert summary["misfit_rms_m"] < 0.001


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--to", "laz", "--crs", "EPSG:25832"], "--crs: there are no positions"),
        (["--to", "laz", "--georeference", "none.txt", "--antenna", "1,2"], "not three numbers"),
        (["--to", "grid", "--georeference", "none.txt"], "only LAS and LAZ"),
        (["--to", "laz", "--georeference", "none.txt", "--crs", "EPSG:4326"], "not metres"),
        (["--to", "laz", "--georeference", "none.txt"], "none.txt"),
    ],
)
def test_what_says_nothing_of_a_survey_is_refused(
    words: list[str], expected: str, small_demo: Path, tmp_path: Path
) -> None:
    if "EPSG:4326" in words:
        pytest.importorskip("pyproj")
    assert_refused(run("export", small_demo, *words, "--out", tmp_path / "out"), expected)
    assert not (tmp_path / "out").exists()


def test_workers_that_would_have_nothing_to_do_are_refused(
    small_demo: Path, tmp_path: Path
) -> None:
    words = ("export", small_demo, "--to", "mesh", "--workers", "2", "--out", tmp_path / "out")
    assert_refused(run(*words), "only grids and OctoMaps")


def test_only_what_is_asked_for_is_made(small_demo: Path, tmp_path: Path) -> None:
    higher = run_settings(small_demo, None, ["grid.min_height_m=2.2", "grid.max_height_m=6"])
    run_export(small_demo, higher, products=["grid"], out=tmp_path / "out")
    files = sorted(p.name for p in (tmp_path / "out").rglob("*") if p.is_file())
    assert files == ["config.yaml", "grid.pgm", "grid.wld", "grid.yaml", "run.json", "summary.json"]
    low, high = (read_nav2(f / "map/grid.yaml") for f in (small_demo, tmp_path / "out"))
    assert ((low.cells == OCCUPIED) & (high.cells != OCCUPIED)).sum() > 10


def test_a_cloud_needs_no_rays(small_demo: Path, tmp_path: Path) -> None:
    run = shutil.copytree(small_demo, tmp_path / "run")
    with Store.open(run / "map/map.recon") as store:
        store.delete("rays")
        store.commit()
    summary = run_export(run, products=["cloud"], out=tmp_path / "out")
    assert summary["points"] > 1000
    with pytest.raises(FormatError, match=r"kept no rays to build occupancy from"):
        run_export(run, products=["grid"], out=tmp_path / "other")
    (run / "map/map.recon").unlink()
    with pytest.raises(FormatError, match=r"folder has no map \(expected a map/map\.recon"):
        run_export(run, products=["cloud"], out=tmp_path / "other")
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--to", "cloud,gird"], "--to: unknown product (got gird, expected cloud, octomap, grid"),
        (["--to", "mesh", "--format", "step"], "unknown mesh format (got step"),
        (["--to", "grid", "--set", "fusion.min_count=1"], "no effect here"),
    ],
)
def test_what_cannot_be_asked_for_is_one_line(
    small_demo: Path, tmp_path: Path, options: list[str], told: str
) -> None:
    done = run("export", small_demo, *options, "--out", tmp_path / "out")
    assert_refused(done, told)
    assert not (tmp_path / "out").exists()


def test_the_run_itself_is_never_replaced(small_demo: Path) -> None:
    with pytest.raises(SettingsError, match="replace the run"):
        run_export(small_demo, products=["cloud"], out=small_demo)


def test_a_run_without_a_map_is_told(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text('{"command": "calibrate"}')
    with pytest.raises(FormatError, match="made no map"):
        run_export(tmp_path, out=tmp_path / "out")
    with pytest.raises(FormatError, match="not contain a finished run"):
        run_export(tmp_path / "nothing", out=tmp_path / "out")


def test_a_pair_gives_its_cloud_and_mesh(pair_run: Path, tmp_path: Path) -> None:
    config = run_settings(pair_run, None, ["mesh.max_depth=5"])
    summary = run_export(pair_run, config, formats=("ply", "glb"), out=tmp_path / "out")
    cloud = "clouds/cloud.ply"
    assert (tmp_path / "out" / cloud).read_bytes() == (pair_run / cloud).read_bytes()
    assert len(read_mesh(tmp_path / "out/mesh/mesh.glb").faces) == summary["faces"]
    assert summary["mesh_coverage"] > 0.5


def test_a_pair_has_no_grid(pair_run: Path, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"a pair has no such product .*grid.*cloud, mesh"):
        run_export(pair_run, load_config(), products=["grid"], out=tmp_path / "out")

"""`recon export` and `recon mesh` make any product of a finished run again."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from recon.commands.config import PAIR_DEFAULTS, load_config, run_settings
from recon.commands.export import run_export, run_mesh, run_occupancy
from recon.commands.pair import run_pair
from recon.core.errors import FormatError, SettingsError
from recon.core.values import RectifiedCamera, StereoPair
from recon.io.models.mesh import read_mesh
from recon.io.models.ply import read_ply
from recon.io.trajectory import read_tum
from recon.map.store.records import Store
from recon.run.batch.cluster import BatchOptions, Cluster
from recon.sources.one_pair import PairInput
from tests.flow.runs import summary_of
from tests.hostile.refusals import assert_refused, run

MAPS = ("map/grid.pgm", "map/grid.yaml", "map/octomap.bt", "map/octomap.ot")


def assert_equal(one: Path, other: Path, *names: str) -> None:
    for name in names:
        assert (one / name).read_bytes() == (other / name).read_bytes(), name


def test_all_products_come_in_one_go(small_demo: Path, tmp_path: Path) -> None:
    config = run_settings(small_demo, None, ["mesh.depth=5", "mesh.min_component_faces=10"])
    summary = run_export(small_demo, config, formats=("ply", "glb"), out=tmp_path / "out")
    assert_equal(tmp_path / "out", small_demo, "map/cloud.ply", *MAPS)
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
    assert_equal(out, small_demo, *MAPS)
    files = sorted(p.name for p in out.rglob("*") if p.is_file())
    maps = [Path(name).name for name in MAPS]
    assert files == sorted([*maps, "grid.wld", "config.yaml", "run.json", "summary.json"])


def test_the_cloud_comes_as_laz_in_the_coordinates_of_a_survey(
    small_demo: Path, tmp_path: Path
) -> None:
    laspy = pytest.importorskip("laspy")
    path, origin = read_tum(small_demo / "trajectory_map_base_tum.txt"), np.array([4e5, 5e6, 100])
    there = np.column_stack([path.timestamps_s, path.positions_m + origin])
    np.savetxt(tmp_path / "gnss.txt", there, fmt="%.6f")
    height_m = summary_of(small_demo)["camera_height_m"]
    words = ["--georeference", tmp_path / "gnss.txt", f"--antenna=0,0,{-height_m}"]
    out = tmp_path / "out"
    done = run("export", small_demo, "--to", "laz", *words, "--crs", "EPSG:25832", "--out", out)
    assert done.code == 0, done.err
    found, cloud = laspy.read(out / "map/cloud.laz"), read_ply(small_demo / "map/cloud.ply")
    assert np.abs(found.xyz - (cloud.xyz.astype(np.float64) + origin)).max() < 0.002
    assert found.header.parse_crs().to_epsg() == 25832
    assert summary_of(out)["misfit_rms_m"] < 0.001


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("laz --crs EPSG:25832", "--crs: there are no positions"),
        ("laz --georeference none.txt --antenna 1,2", "not three numbers"),
        ("grid --georeference none.txt", "only LAS and LAZ"),
        ("laz --georeference none.txt --crs EPSG:4326", "not metres"),
        ("laz --georeference none.txt", "none.txt"),
        ("cloud,gird", "--to: unknown product (got gird, expected cloud, octomap, grid"),
        ("mesh --format step", "unknown mesh format (got step"),
        ("grid --set fusion.min_count=1", "no effect here"),
        ("mesh --workers 2", "only grids and OctoMaps"),
    ],
)
def test_what_cannot_be_asked_for_is_one_line(
    small_demo: Path, tmp_path: Path, options: str, said: str
) -> None:
    if "EPSG:4326" in options:
        pytest.importorskip("pyproj")
    words = ("--to", *options.split(), "--out", tmp_path / "out")
    assert_refused(run("export", small_demo, *words), said)
    assert not (tmp_path / "out").exists()


@pytest.fixture
def without_rays(small_demo: Path, tmp_path: Path) -> Path:
    run = Path(shutil.copytree(small_demo, tmp_path / "run"))
    with Store.open(run / "map/map.recon") as store:
        store.delete("rays")
        store.commit()
    return run


def test_what_is_not_there_is_told(without_rays: Path, tmp_path: Path) -> None:
    summary = run_export(without_rays, products=["cloud"], out=tmp_path / "out")
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
def test_the_run_itself_is_never_replaced(small_demo: Path, make: Callable[..., Any]) -> None:
    with pytest.raises(SettingsError, match="replace the run"):
        make(small_demo, run_settings(small_demo, None, []), out=small_demo)


def test_a_pair_gives_its_cloud_and_mesh_and_no_grid(tmp_path: Path) -> None:
    noise = np.random.default_rng(3).integers(0, 256, (120, 180)).astype(np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5)
    world = np.asarray(cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX), np.uint8)
    pair = StereoPair(world[:, :160], world[:, 12:172], name="left.png")
    camera, run = RectifiedCamera(150.0, 80.0, 60.0, 80.0, 0.1, 160, 120), tmp_path / "run"
    shallow = ["mesh.max_depth=5"]
    run_pair(PairInput(pair, camera), load_config(None, shallow, PAIR_DEFAULTS), out=run)
    config = run_settings(run, None, shallow)
    summary = run_export(run, config, formats=("ply", "glb"), out=tmp_path / "out")
    assert_equal(tmp_path / "out", run, "clouds/cloud.ply")
    assert len(read_mesh(tmp_path / "out/mesh/mesh.glb").faces) == summary["faces"]
    assert summary["mesh_coverage"] > 0.5
    with pytest.raises(SettingsError, match=r"a pair has no such product .*grid.*cloud, mesh"):
        run_export(run, load_config(), products=["grid"], out=tmp_path / "out")


def mesh_of(run: Path, out: Path, *settings: str) -> dict[str, Any]:
    # What is written is asked, not how fine it is.
    config = load_config(None, ["mesh.tile_m=10", "mesh.max_depth=5", *settings])
    return run_mesh(run, config, out=out, formats=("ply", "glb"))


def layers(out: Path) -> list[str]:
    return re.findall(r'filename="(.*?)"', (out / "mesh/mesh.mlp").read_text())


def test_the_map_of_a_run_is_meshed_in_pieces(small_demo: Path, tmp_path: Path) -> None:
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
    small_demo: Path, without_rays: Path, tmp_path: Path
) -> None:
    one, out = "mesh.tile_m=1000", tmp_path / "cut"
    cut = mesh_of(small_demo, out, one)
    assert cut["tiles"] == 1
    assert layers(out) == ["mesh.ply", "cloud.ply"]
    files = sorted(p.name for p in (out / "mesh").iterdir() if p.is_file())
    assert files == ["cloud.ply", "mesh.glb", "mesh.mlp", "mesh.ply"]
    kept = mesh_of(small_demo, tmp_path / "kept", one, "mesh.free_space=false")
    assert kept["faces"] > cut["faces"] > 100
    [*_, warning] = mesh_of(without_rays, tmp_path / "unknown", one)["warnings"]
    assert "free space is not known" in warning

"""`recon mesh` of a run: its map in pieces, without the faces in free space."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from recon.commands.config import load_config
from recon.commands.export import run_mesh
from recon.core.errors import FormatError, SettingsError
from recon.io.models.mesh import read_mesh
from recon.io.models.ply import read_ply
from recon.map.store.records import Store


def mesh_of(run: Path, out: Path, *settings: str) -> dict[str, Any]:
    # What is written is asked, not how fine it is.
    config = load_config(None, ["mesh.tile_m=10", "mesh.max_depth=5", *settings])
    return run_mesh(run, config, out=out, formats=("ply", "glb"))


@pytest.fixture(scope="module")
def meshed(
    small_demo: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, Any]]:
    """What `recon mesh` made of a run, and its summary; not to be changed."""
    out = tmp_path_factory.mktemp("meshed") / "mesh"
    return out, mesh_of(small_demo, out)


def test_the_map_of_a_run_is_meshed_in_pieces(meshed: tuple[Path, dict[str, Any]]) -> None:
    out, summary = meshed
    assert summary["tiles"] >= 2
    assert not [text for text in summary["warnings"] if "free space" in text]
    assert len(read_mesh(out / "mesh/mesh.glb").faces) == summary["faces"] > 100
    layers = re.findall(r'filename="(.*?)"', (out / "mesh/mesh.mlp").read_text())
    assert len(layers) == summary["tiles"] + 1
    assert all((out / "mesh" / str(layer)).is_file() for layer in layers)


def test_the_cloud_beside_the_mesh_is_that_of_the_run(
    small_demo: Path, meshed: tuple[Path, dict[str, Any]]
) -> None:
    out, summary = meshed
    cloud = small_demo / "map/cloud.ply"
    assert (out / "mesh/cloud.ply").read_bytes() == cloud.read_bytes()
    assert summary["points"] == len(read_ply(cloud))


def test_one_piece_is_the_mesh_itself(small_demo: Path, tmp_path: Path) -> None:
    summary = mesh_of(small_demo, tmp_path / "out", "mesh.tile_m=1000")
    assert summary["tiles"] == 1
    folder = tmp_path / "out/mesh"
    layers = re.findall(r'filename="(.*?)"', (folder / "mesh.mlp").read_text())
    assert layers == ["mesh.ply", "cloud.ply"]
    assert sorted(p.name for p in folder.iterdir() if p.is_file()) == [
        "cloud.ply", "mesh.glb", "mesh.mlp", "mesh.ply",
    ]  # fmt: skip


def test_faces_in_free_space_are_removed(small_demo: Path, tmp_path: Path) -> None:
    kept, cut = (
        mesh_of(small_demo, tmp_path / value, "mesh.tile_m=1000", f"mesh.free_space={value}")
        for value in ("false", "true")
    )
    assert kept["faces"] > cut["faces"] > 100


def test_a_map_without_rays_is_meshed_with_a_warning(small_demo: Path, tmp_path: Path) -> None:
    run = shutil.copytree(small_demo, tmp_path / "run")
    with Store.open(run / "map/map.recon") as store:
        store.delete("rays")
        store.commit()
    [*_, warning] = mesh_of(run, tmp_path / "out")["warnings"]
    assert "free space is not known" in warning


def test_a_damaged_map_leaves_the_earlier_mesh(
    small_demo: Path, meshed: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    run, out = shutil.copytree(small_demo, tmp_path / "run"), tmp_path / "mesh"
    shutil.copytree(meshed[0], out)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with (run / "map/map.recon").open("r+b") as file:
        file.truncate(5000)
    with pytest.raises(FormatError, match=r"map\.recon"):
        mesh_of(run, out)
    assert before == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


def test_the_run_itself_is_never_replaced(small_demo: Path) -> None:
    with pytest.raises(SettingsError, match="replace the run"):
        run_mesh(small_demo, load_config(None, []), out=small_demo)

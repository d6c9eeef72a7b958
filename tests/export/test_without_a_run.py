"""Products of a map that is in memory, or open, without the folder of a run."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

import recon
from recon.core.errors import FormatError, OutputError, ReconError, SettingsError, SourceError
from recon.core.geometry.se3 import apply
from recon.core.kernels.voxels import pack_keys
from recon.export.make import PRODUCTS, make
from recon.export.product import ExportContext
from recon.io.models.octomap import read_octomap
from tests.map import walls

STREET = {"frames": 8, "width_px": 192, "height_px": 72, "focal_px": 110.0}
CONFIG = recon.load_config(
    {"street": STREET}, {"fusion.min_count": 1, "mesh.depth": 5, "mesh.min_component_faces": 10}
)
TOOLS = {"las": "laspy", "laz": "laspy", "copc": "laspy", "e57": "pye57", "mcap": "rosbags",
         "gridmap": "rosbags", "colmap": "pycolmap"}  # fmt: skip
TOOLS |= {"contours": "pyogrio"}
TOOLS |= dict.fromkeys(("dsm", "dtm", "slope", "orthophoto", "grid-geotiff"), "rasterio")


@pytest.fixture(scope="module")
def mapped():
    return recon.map_sequence(recon.SyntheticSource(CONFIG.street), CONFIG)


def files_in(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


SLOW = ("texture", "mcap", "colmap", "nerfstudio")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] if n in SLOW else []) for n in PRODUCTS]
)
def test_every_product_is_what_a_run_has_and_nothing_else(mapped, tmp_path, name):
    pytest.importorskip(TOOLS.get(name, "numpy"))
    product = PRODUCTS[name]
    formats = (product.suffix.lstrip("."),)
    context = ExportContext(mapped.map, mapped.placed, CONFIG.mesh, formats=formats)
    made = make(context, tmp_path / "run", [name])
    path = tmp_path / "there" / Path(product.name).name
    found = recon.export_map(mapped, name, path, threads=1)
    assert (found.figures, [*found.warnings]) == (
        made.figures[name],
        [*mapped.map.doubts, *made.warnings],
    )
    if product.suffix:
        files = {path.name.removesuffix(product.suffix) + end for end in product.parts}
        assert {file.name for file in path.parent.iterdir()} == {path.name, *files}
        theirs = (tmp_path / "run" / product.name).parent
    else:
        theirs = tmp_path / "run" / product.name
        assert files_in(path) == files_in(theirs) != {}
        return
    if name == "e57":  # it has an identifier, and the time
        assert path.stat().st_size > 1000
        return
    for file in path.parent.iterdir():
        assert file.read_bytes() == (theirs / file.name).read_bytes(), file.name


@pytest.mark.parametrize(("name", "end"), [("mesh", ".obj"), ("mesh", ".STL"), ("octomap", ".ot")])
def test_a_suffix_chooses_among_the_formats_of_a_product(mapped, tmp_path, name, end):
    recon.export_map(mapped, name, tmp_path / f"a.b{end}")
    assert [path.name for path in tmp_path.iterdir()] == [f"a.b{end}"]
    if name == "octomap":
        found = pack_keys(read_octomap(tmp_path / "a.b.ot").keys)
        assert len(found) > 10_000
        assert np.isin(found, pack_keys(mapped.voxels.keys)).all()
    else:
        (tmp_path / f"a.b{end}").rename(tmp_path / f"c{end.lower()}")
        mesh = recon.read_mesh(tmp_path / f"c{end.lower()}")
        xyz = apply(mapped.T_map_world, mapped.cloud.xyz)
        apart_m = cKDTree(xyz).query(mesh.vertices)[0]
        # Points are 0.1 m apart.
        assert np.median(apart_m) < 0.05
        assert apart_m.max() < 0.3


def test_a_grid_that_is_read_is_the_one_that_was_made_also_with_other_settings(mapped, tmp_path):
    made = recon.export_map(mapped, "grid", tmp_path / "grid.yaml")
    back = recon.read_grid(tmp_path / "grid.yaml")
    np.testing.assert_array_equal(back.cells, made.value.cells)
    np.testing.assert_allclose(back.origin_m, made.value.origin_m, rtol=1e-12)
    assert back.resolution_m == made.value.resolution_m
    changes = {"grid.max_height_m": 0.6, "occupancy.resolution_m": 0.4}
    recon.export_map(mapped, "grid", tmp_path / "grid.yaml", changes)
    other = recon.read_grid(tmp_path / "grid.yaml")
    assert other.resolution_m == 0.4
    assert (other.cells == recon.core.values.OCCUPIED).sum() < (back.cells == 100).sum()


def test_a_file_is_replaced_and_an_input_or_a_folder_is_not(mapped, tmp_path):
    (tmp_path / "a.ply").write_text("old")
    recon.export_map(mapped, "cloud", str(tmp_path / "a.ply"))
    assert len(recon.read_ply(tmp_path / "a.ply")) > 1000
    (tmp_path / "b.yaml").mkdir()
    (tmp_path / "c.pgm").mkdir()
    os.mkfifo(tmp_path / "d.ply")
    for name, path in (("grid", "b.yaml"), ("grid", "c.yaml"), ("cloud", "d.ply")):
        with pytest.raises(OutputError, match="expected a regular file"):
            recon.export_map(mapped, name, tmp_path / path)
    with walls.drives(1) as map_:
        map_.store.path = tmp_path / "e.ply"  # as if the map had the name of a cloud
        (tmp_path / "e.ply").write_text("the map")
        with pytest.raises(SettingsError, match="replace an input"):
            recon.export_map(map_, "cloud", tmp_path / "e.ply")
    assert names_in(tmp_path) == [
        "a.ply",
        "b.yaml",
        "c.pgm",
        "d.ply",
        "e.ply",
    ]


@pytest.mark.parametrize(
    ("name", "path"),
    [("grid", "a.pgm"), ("grid", "a"), ("cloud", ".ply"), ("cloud", "a.PLX"), ("copc", "a.laz"),
     ("mesh", "a.xyz"), ("dsm", "a.tiff"), ("texture", "a.obj"), ("cloud", ".")],
)  # fmt: skip
def test_a_name_of_another_kind_of_file_is_refused_before_the_work(tmp_path, name, path):
    with walls.drives(1) as map_, pytest.raises(OutputError, match="another kind of file"):
        recon.export_map(map_, name, tmp_path / path)
    assert not [*tmp_path.iterdir()]


def test_a_folder_that_is_not_empty_a_file_and_a_link_are_no_place_for_a_folder(mapped, tmp_path):
    pytest.importorskip("rosbags")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("")
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to("empty")
    for path in ("full", "full/mine", "link"):
        with pytest.raises(OutputError, match="exists already"):
            recon.export_map(mapped, "gridmap", tmp_path / path)
    recon.export_map(mapped, "gridmap", tmp_path / "empty")
    assert names_in(tmp_path / "empty") == [
        "empty.mcap",
        "metadata.yaml",
    ]
    assert names_in(tmp_path) == ["empty", "full", "link"]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"product": "girds"}, "unknown product.*girds.*octomap"),
        ({"changes": {"grid.nothing": 1}}, "unknown setting"),
        ({"changes": {"fusion.voxel_m": 1.0}}, "no effect here"),
        ({"changes": ["grid.max_height_m=none"]}, "max_height_m"),
        ({"map_": "outputs/map/latest"}, r"not a map \(got str, expected Map\.open"),
    ],
)
def test_what_there_is_not_is_refused(mapped, tmp_path, given, said):
    how = {"map_": mapped, "product": "grid", "path": tmp_path / "a.yaml"} | given
    with pytest.raises(ReconError, match=said):
        recon.export_map(**how)
    assert not [*tmp_path.iterdir()]


def test_what_a_map_lacks_is_said(tmp_path):
    config = recon.load_config(walls.CONFIG, {"occupancy.keep_rays": False})
    with recon.Map.temporary() as map_, walls.drives(1) as whole:
        walls.drive(map_, walls.TRUE[0], 0, config=config)
        map_.store.delete("rays")
        for session in map_.sessions:
            session.submaps.entries[:] = []
        with pytest.raises(FormatError, match="no rays"):
            recon.export_map(map_, "grid", tmp_path / "a.yaml")
        with pytest.raises(SourceError, match="where the images of the drive are"):
            recon.export_map(whole, "texture", tmp_path / "a.glb")
        with recon.Map.temporary() as empty, pytest.raises(FormatError, match="no drive"):
            recon.export_map(empty, "cloud", tmp_path / "a.ply")
    assert not [*tmp_path.iterdir()]

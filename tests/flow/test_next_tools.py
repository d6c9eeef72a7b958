"""Products for other tools are opened by the libraries of those tools, and are right there."""

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest
from scipy.spatial import cKDTree

from recon.commands.config import load_config, run_settings
from recon.commands.demo import demo_source
from recon.commands.export import run_export
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.geometry.se3 import T_YUP_FRAME, apply, invert
from recon.core.values.camera import unproject
from recon.export import nerfstudio
from recon.io.images.image import read_image, read_levels
from recon.io.models.mesh import read_mesh
from recon.io.models.ply import read_ply
from recon.io.models.rasters import read_grid
from recon.io.trajectory import read_tum
from recon.map.map import Map
from recon.map.store.session import SESSION
from tests.flow.runs import content, summary_of
from tests.hostile.refusals import assert_refused, run
from tests.scenery.kitti import street_drive


@pytest.fixture(scope="module")
def exported(small_demo, tmp_path_factory):
    """What is made of the demo for COLMAP and nerfstudio."""
    out = tmp_path_factory.mktemp("next") / "out"
    run_export(small_demo, products=["colmap", "nerfstudio"], out=out)
    return out


@pytest.fixture(scope="module")
def mapped(small_demo):
    """Camera and poses in map axes of the demo."""
    with Map.open(small_demo) as map_:
        return map_.first.camera, map_.first.T_map_world @ map_.first.trajectory.T_world_camera


def test_colmap_finds_poses_rig_points_and_images_as_they_are(
    exported, mapped, small_demo, tmp_path
):
    pycolmap = pytest.importorskip("pycolmap")
    camera, poses = mapped
    # It reads binary files, and text where there are none.
    text = Path(shutil.copytree(exported / "colmap/sparse/0", tmp_path / "text"))
    for path in text.glob("*.bin"):
        path.unlink()
    model, same = (pycolmap.Reconstruction(str(p)) for p in (exported / "colmap/sparse/0", text))
    for name in ("cameras", "rigs", "frames", "images", "points3D"):
        assert repr(dict(getattr(model, name))) == repr(dict(getattr(same, name)))
    tracks = [[p.track.elements for p in m.points3D.values()] for m in (model, same)]
    assert repr(tracks[0]) == repr(tracks[1])
    summary = summary_of(exported)
    assert model.num_images() == summary["colmap_images"] == 2 * len(poses)
    assert model.num_frames() == len(poses)
    assert model.num_points3D() == summary["colmap_points"] > 100
    (rig,) = model.rigs.values()
    left, right = model.cameras[1], model.cameras[2]
    assert rig.is_ref_sensor(left.sensor_id)
    beside = rig.sensor_from_rig(right.sensor_id).matrix()
    np.testing.assert_allclose(beside[:, 3], [-camera.baseline_m, 0, 0], atol=1e-12)
    images = {image.name: image for image in model.images.values()}
    for frame, T_map_camera in enumerate(poses):
        for side, at in (("left", 0.0), ("right", camera.baseline_m)):
            image = images[f"{side}_{frame:06d}.png"]
            T = invert(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]))
            place = apply(T_map_camera, np.array([[at, 0.0, 0.0]]))[0]
            np.testing.assert_allclose(T[:3, 3], place, atol=1e-9)
            np.testing.assert_allclose(T[:3, :3], T_map_camera[:3, :3], atol=1e-9)
            pixels = read_image(exported / "colmap/images" / image.name)
            assert pixels.shape[:2] == (camera.height_px, camera.width_px)
    off_px = [
        [
            np.linalg.norm(
                model.images[seen.image_id].project_point(point.xyz)
                - model.images[seen.image_id].points2D[seen.point2D_idx].xy
            )
            for seen in point.track.elements
        ]
        for point in model.points3D.values()
    ]
    assert np.median(np.concatenate(off_px)) < 0.5
    assert max(map(max, off_px)) < 4.0
    # COLMAP's own error of a point: the mean over the images that see it.
    for of in (model, same):
        errors = [point.error for point in of.points3D.values()]
        np.testing.assert_allclose(errors, [np.mean(one) for one in off_px], atol=1e-9)
    sides = {model.images[s.image_id].camera_id for p in model.points3D.values()
             for s in p.track.elements}  # fmt: skip
    assert sides == {1, 2}
    # Points within the range of the map are on what was mapped, in its colours.
    cloud = read_ply(small_demo / "map/cloud.ply").xyz
    xyz = np.array([point.xyz for point in model.points3D.values()])
    far_m = np.linalg.norm(xyz[:, None] - poses[:, :3, 3], axis=2).max(axis=1)
    near = [np.linalg.norm(cloud - one, axis=1).min() for one in xyz[far_m < 20]]
    assert len(near) > 20
    assert np.median(near) < 0.3
    assert len({tuple(point.color) for point in model.points3D.values()}) > 20


def test_nerfstudio_sees_the_map_through_its_own_cameras(exported, mapped, small_demo):
    camera, poses = mapped
    told = json.loads((exported / "nerfstudio/transforms.json").read_text())
    assert len(told["frames"]) == len(poses)
    assert (told["w"], told["h"], told["cx"]) == (256, 96, camera.cx_px + 0.5)
    cloud = read_ply(small_demo / "map/cloud.ply").xyz
    source = demo_source(run_settings(small_demo))
    for frame in (0, 7):
        one = told["frames"][frame]
        image, depth_mm = (
            read_levels(exported / "nerfstudio" / one[name])
            for name in ("file_path", "depth_file_path")
        )
        truth = source.frame(frame)
        np.testing.assert_array_equal(image, truth.pair.left)
        assert depth_mm.dtype == np.uint16
        known = depth_mm > 0
        assert 0.2 < known.mean() < 1.0
        off_m = np.abs(depth_mm / 1000 - truth.depth_m)[known]
        assert np.nanmedian(off_m / truth.depth_m[known]) < 0.02
        # Nerfstudio's rays: pixel centres at 0.5, y up, the camera looks along -z.
        v, u = np.nonzero(known)
        z = depth_mm[v, u] / 1000
        x, y = (u + 0.5 - told["cx"]) / told["fl_x"], (v + 0.5 - told["cy"]) / told["fl_y"]
        seen = np.column_stack([x, -y, -np.ones(len(x))]) * z[:, None]
        there = apply(np.array(one["transform_matrix"]), seen)
        ours = unproject(u.astype(float), v.astype(float), z, camera)
        np.testing.assert_allclose(there, apply(poses[frame], ours), atol=1e-9)
    points = read_ply(exported / "nerfstudio" / told["ply_file_path"])
    assert len(points) == len(cloud)


def test_what_moved_is_masked_where_it_is_seen(mapped):
    camera, _ = mapped
    depth_m = np.full((camera.height_px, camera.width_px), np.nan, np.float32)
    depth_m[30:60, 100:140] = 8.0
    depth_m[40:42, 110:112] = np.nan  # a gap in it
    v, u = np.nonzero(depth_m == 8.0)
    xyz = unproject(u.astype(np.float32), v.astype(np.float32), depth_m[v, u], camera)
    seen = nerfstudio.shadow(xyz, camera, 0.1)
    assert seen[30:60, 100:140].all()
    assert seen.sum() == 30 * 40
    assert not nerfstudio.shadow(xyz[:0], camera, 0.1).any()


def test_a_grid_map_has_its_layers_where_the_map_has_them(small_demo, tmp_path):
    pytest.importorskip("rosbags")
    rasterio = pytest.importorskip("rasterio")
    from rosbags.highlevel import AnyReader

    assert run("export", small_demo, "--to", "gridmap,grid,dtm", "--out", tmp_path).code == 0
    with AnyReader([tmp_path / "gridmap"]) as bag:  # by the definitions in the bag itself
        ((connection, _, raw),) = bag.messages()
        told = bag.deserialize(raw, connection.msgtype)
    assert (connection.topic, connection.msgtype) == ("/grid_map", "grid_map_msgs/msg/GridMap")
    assert told.header.frame_id == "map"
    assert told.layers == ["elevation", "slope", "occupancy", "traversability"]
    (columns, rows), info = told.data[0].layout.dim, told.info
    assert (columns.label, rows.label) == ("column_index", "row_index")
    assert rows.size == round(info.length_x / info.resolution)
    assert columns.size == round(info.length_y / info.resolution)
    assert columns.stride == rows.size * columns.size

    def layer(name):
        """Values at x and y, by the rule of grid_map: indices grow backwards and to the right."""
        values = told.data[told.layers.index(name)].data
        i, j = np.arange(rows.size), np.arange(columns.size)
        x = info.pose.position.x + info.length_x / 2 - (i + 0.5) * info.resolution
        y = info.pose.position.y + info.length_y / 2 - (j + 0.5) * info.resolution
        return x, y, values.reshape(columns.size, rows.size).T

    grid = read_grid(tmp_path / "map/grid.yaml")
    x, y, occupancy = layer("occupancy")
    at = [np.floor((xy - o) / 0.2).astype(int) for xy, o in zip((x, y), grid.origin_m, strict=True)]
    expected = grid.cells[np.ix_(at[1], at[0])].T
    np.testing.assert_array_equal(np.nan_to_num(occupancy, nan=-1), expected)
    _, _, elevation = layer("elevation")
    with rasterio.open(tmp_path / "map/dtm.tif") as file:
        wanted, window = file.read(1), file.transform
    v, u = np.nonzero(np.isfinite(wanted))
    east, north = window @ (u + 0.5, v + 0.5)
    i = np.rint((x[0] - east) / info.resolution).astype(int)
    j = np.rint((y[0] - north) / info.resolution).astype(int)
    np.testing.assert_allclose(elevation[i, j], wanted[v, u], atol=1e-5)
    assert np.nanmax(layer("slope")[2]) < np.pi / 2
    passable = layer("traversability")[2]
    assert 0 <= np.nanmin(passable) < np.nanmax(passable) <= 1


def test_a_bag_says_in_messages_of_ros_what_the_map_is(small_demo, mapped, tmp_path):
    pytest.importorskip("mcap")
    from mcap.reader import make_reader
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    camera, poses = mapped
    based = read_tum(small_demo / "trajectory_map_base_tum.txt")
    there = np.column_stack([based.timestamps_s, based.positions_m + np.array([4e5, 5e6, 100])])
    np.savetxt(tmp_path / "gnss.txt", there, fmt="%.6f")
    words = ["--to", "mcap,grid", "--georeference", tmp_path / "gnss.txt"]
    done = run("export", small_demo, *words, "--out", tmp_path / "out")
    assert done.code == 0, done.err
    out, store = tmp_path / "out", get_typestore(Stores.ROS2_HUMBLE)
    found: dict[str, list] = {}
    with (out / "bag/bag.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            content = store.deserialize_cdr(message.data, schema.name)
            found.setdefault(channel.topic, []).append((message.log_time, content))
    with Reader(out / "bag") as bag:  # the folder, as ros2 bag play takes it
        assert bag.message_count == sum(map(len, found.values()))
    frames = len(poses)
    assert {topic: len(all_) for topic, all_ in found.items()} == {
        "/tf_static": 1, "/map/grid": 1, "/map/cloud": 1, "/tf": frames, "/odometry": frames,
        "/points": frames, "/left/image/compressed": frames, "/right/image/compressed": frames,
        "/left/camera_info": frames, "/right/camera_info": frames,
    }  # fmt: skip
    edges = {edge.child_frame_id: edge for edge in found["/tf_static"][0][1].transforms}
    assert {child: edge.header.frame_id for child, edge in edges.items()} == {
        "map": "survey", "left": "base_link", "right": "left",
    }  # fmt: skip
    assert edges["map"].transform.translation.y == pytest.approx(5e6, abs=5)
    for frame, (time_ns, message) in enumerate(found["/odometry"]):
        assert time_ns == round(1e9 * based.timestamps_s[frame])
        place, spread = message.pose.pose.position, message.pose.covariance.reshape(6, 6)
        at = based.positions_m[frame]
        np.testing.assert_allclose([place.x, place.y, place.z], at, atol=1e-6)
        assert (np.diag(spread) > 0).all() == (frame > 0)
    grid, file = found["/map/grid"][0][1], summary_of(out)
    assert (grid.info.height, grid.info.width) == (file["rows"], file["columns"])
    assert (grid.data == 100).sum() == file["occupied_cells"]
    cloud, shown = read_ply(small_demo / "map/cloud.ply"), found["/map/cloud"][0][1]
    rows = shown.data.view(np.float32).reshape(-1, len(shown.fields))
    assert [field.name for field in shown.fields] == ["x", "y", "z", "rgb", "sigma"]
    np.testing.assert_array_equal(np.sort(rows[:, 0]), np.sort(cloud.xyz[:, 0]))
    packed = rows[:, 3].copy().view(np.uint32)
    assert set((packed >> 16).tolist()) <= set(range(256))
    assert sorted((packed & 255).tolist()) == sorted(cloud.rgb[:, 2].tolist())
    image = cv2.imdecode(found["/left/image/compressed"][0][1].data, cv2.IMREAD_COLOR)
    assert image.shape[:2] == (camera.height_px, camera.width_px)
    right = found["/right/camera_info"][0][1].p.reshape(3, 4)
    assert right[0, 3] == pytest.approx(-camera.focal_px * camera.baseline_m)
    layout = json.loads((out / "bag/foxglove.json").read_text())
    assert set(layout["configById"]["3D!map"]["topics"]) <= set(found)


def test_a_bag_without_its_package_says_what_to_install(small_demo, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    done = run("export", small_demo, "--to", "mcap", "--out", tmp_path / "out")
    assert_refused(done, "pip install 'recon-stereo[ros]'")
    assert not (tmp_path / "out").exists()


def test_products_made_again_are_the_same_bytes(small_demo, exported, tmp_path):
    pytest.importorskip("rosbags")
    run_export(small_demo, products=["mcap", "colmap"], out=tmp_path / "both")
    run_export(small_demo, products=["mcap"], out=tmp_path / "once")
    both = content(tmp_path / "both")
    for folder, again in (("bag", content(tmp_path / "once")), ("colmap", content(exported))):
        made = {name: both[name] for name in both if name.startswith(folder)}
        assert made
        assert made == {name: again[name] for name in again if name.startswith(folder)}


@pytest.fixture(scope="module")
def drive_run(tmp_path_factory):
    """A drive in files that was mapped, and the folder of its run."""
    folder = tmp_path_factory.mktemp("drive")
    drive = street_drive(folder / "ride", frames=4)
    options = MapOptions(audit=False, out=folder / "run", mesh=False, source=drive)
    source, options = options.open(load_config())
    run_map(source, load_config(), options)
    return drive, folder / "run"


def test_a_drive_is_read_again_from_where_it_is_now(drive_run, tmp_path):
    drive, mapped = drive_run
    done = run("export", mapped, "--to", "colmap", "--out", tmp_path / "one")
    assert done.code == 0, done.err
    moved = tmp_path / "elsewhere"
    shutil.copytree(drive, moved)
    hidden = drive.rename(drive.with_name("hidden"))
    try:
        gone = run("export", mapped, "--to", "colmap", "--out", tmp_path / "none")
        assert_refused(gone, str(drive), "folder does not exist", "--images")
        found = run(
            "export", mapped, "--to", "colmap", "--images", moved, "--out", tmp_path / "two"
        )
        assert found.code == 0, found.err
        done = run("export", mapped, "--to", "mcap", "--out", tmp_path / "bag")
        assert done.code == 0, done.err
        assert "no images in the bag" in summary_of(tmp_path / "bag")["warnings"][-1]
    finally:
        hidden.rename(drive)
    assert content(tmp_path / "one") == content(tmp_path / "two")
    for camera in ("image_0", "image_2"):
        one, other = (moved / camera / f"00000{k}.png" for k in (1, 2))
        other.write_bytes(one.read_bytes())
    done = run("export", mapped, "--to", "colmap", "--images", moved, "--out", tmp_path / "no")
    assert_refused(done, str(moved), "changed")
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize(("start", "said"), [
    ({}, "does not say where the images"),
    ({"images": [1]}, "map.recon"),
    ({"images": {"source": 5}}, "map.recon"),
    ({"images": {"source": "/nowhere", "mark": None}}, "map.recon"),
    ({"images": {"source": "/nowhere", "kind": "none"}}, "unknown kind of source"),
    ({"images": {"source": "/nowhere", "kind": "kitti"}}, "/nowhere"),
])  # fmt: skip
def test_a_map_that_says_nothing_or_nonsense_of_its_images_is_refused(
    drive_run, tmp_path, start, said
):
    shutil.copytree(drive_run[1], tmp_path / "run")
    with Map.open(tmp_path / "run", read_only=False) as map_:
        map_.store.put(SESSION, 0, asdict(replace(map_.first.info, start=start)))
        map_.commit()
    done = run("export", tmp_path / "run", "--to", "nerfstudio", "--out", tmp_path / "out")
    assert_refused(done, said, "" if "recon" in said else "--images")


def test_a_textured_drive_shows_its_images_in_other_programs(small_demo, tmp_path):
    out = tmp_path / "out"
    formats = ("obj", "glb")
    figures = run_export(small_demo, products=["texture"], formats=formats, out=out).to_json()
    assert 0.5 < figures["textured"] <= 1
    mesh = read_mesh(out / "mesh" / "mesh.ply")
    # A GLB is turned upright.
    for suffix, R_file_map in zip(formats, (np.eye(3), T_YUP_FRAME["map"][:3, :3]), strict=True):
        shown = o3d.io.read_triangle_mesh(out / "texture" / f"mesh.{suffix}", True)
        picture, uv = np.asarray(shown.textures[0]), np.asarray(shown.triangle_uvs)
        assert max(picture.shape) == figures["texture_px"]
        assert 0 <= uv.min() <= uv.max() <= 1
        # At the vertices it shows what the fused points have, and what is finer than they are.
        corners = np.asarray(shown.vertices)[np.asarray(shown.triangles).ravel()] @ R_file_map
        nearest = cKDTree(mesh.vertices).query(corners)[1]
        column, row = (uv * picture.shape[1::-1]).astype(int).T
        grey = picture[row, column].mean(axis=1), mesh.rgb[nearest].mean(axis=1)
        assert np.corrcoef(*grey)[0, 1] > 0.6
    project = (out / "texture" / "mesh.mlp").read_text()
    images = re.findall(r'fileName="(images/.*?)"', project)
    assert len(images) >= 2
    assert all((out / "texture" / name).is_file() for name in images)


TEXTURING = """<!DOCTYPE FilterScript><FilterScript>
<filter name="Parameterization + texturing from registered rasters">
<Param type="RichInt" value="1024" name="textureSize"/>
<Param type="RichString" value="painted.png" name="textureName"/>
<Param type="RichBool" value="false" name="colorCorrection"/>
<Param type="RichInt" value="1" name="colorCorrectionFilterSize"/>
<Param type="RichBool" value="true" name="useDistanceWeight"/>
<Param type="RichBool" value="true" name="useImgBorderWeight"/>
<Param type="RichBool" value="false" name="useAlphaWeight"/>
<Param type="RichBool" value="true" name="cleanIsolatedTriangles"/>
<Param type="RichBool" value="false" name="stretchingAllowed"/>
<Param type="RichInt" value="4" name="textureGutter"/>
</filter></FilterScript>"""


@pytest.mark.slow
def test_meshlab_paints_a_drive_with_the_rasters_of_its_project(small_demo, tmp_path):
    """MeshLab of Debian, without a screen: its cameras lead where ours do."""
    for program in ("meshlabserver", "xvfb-run"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    out = tmp_path / "out"
    run_export(small_demo, products=["texture"], out=out)
    (tmp_path / "paint.mlx").write_text(TEXTURING)
    words = ["xvfb-run", "-a", "-s", "-screen 0 1280x800x24 +extension GLX", "meshlabserver"]
    words += ["-p", out / "texture/mesh.mlp", "-s", tmp_path / "paint.mlx"]
    environment = {**os.environ, "LIBGL_ALWAYS_SOFTWARE": "1"}
    painted = out / "texture/painted.obj"
    subprocess.run([*words, "-o", painted, "-m", "wt"], check=True, env=environment, timeout=300)
    mesh, shown = read_mesh(out / "mesh/mesh.ply"), o3d.io.read_triangle_mesh(str(painted), True)
    picture, uv = read_image(out / "texture/painted.png"), np.asarray(shown.triangle_uvs)
    corners = np.asarray(shown.vertices)[np.asarray(shown.triangles).ravel()]
    nearest = cKDTree(mesh.vertices).query(corners)[1]
    column, row = np.clip(uv * 1024, 0, 1023).astype(int).T
    grey = picture[1023 - row, column].mean(axis=1), mesh.rgb[nearest].mean(axis=1)
    seen = grey[0] > 0
    assert seen.mean() > 0.3
    assert np.corrcoef(grey[0][seen], grey[1][seen])[0, 1] > 0.6

"""The 3-D view: what is drawn, from where, and how it is thinned and packed."""

import base64
import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.values import PointCloud
from recon.report.scene import Points, Scene, thin_cloud, thin_mesh, upright_scene
from recon.report.view3d import plot, quantise_colours, view_of


def scene_of(cloud: PointCloud, **more: Any) -> Scene:
    return Scene((Points("cloud", cloud),), **more)


def plotted(scene: Scene, max_points: int = 120_000) -> dict[str, Any]:
    return plot(view_of(scene, max_points))


def unpack(packed: dict[str, str]) -> np.ndarray[Any, Any]:
    return np.frombuffer(base64.b64decode(packed["bdata"]), dtype=packed["dtype"])


def test_points_are_turned_upright_and_their_colours_come_back_from_the_scale():
    """Camera axes: forward is z and up is -y; in the view forward is x and up is z."""
    ahead_and_up = PointCloud(np.array([[0, -2, 5], [0, -2, 5]], dtype=np.float32))
    trace = plotted(upright_scene(ahead_and_up))["data"][0]
    assert [unpack(trace[axis])[0] for axis in "xyz"] == [5.0, 0.0, 2.0]
    rgb = np.array([[10, 20, 30], [200, 100, 0]], dtype=np.uint8)
    cloud = PointCloud(np.array([[0, 0, 0], [1, 1, 1]], dtype=np.float32), rgb=rgb)
    marker = plotted(scene_of(cloud))["data"][0]["marker"]
    named = [marker["colorscale"][place][1] for place in unpack(marker["color"])]
    assert named == ["rgb(10,20,30)", "rgb(200,100,0)"]
    assert marker["cmax"] == len(marker["colorscale"]) - 1
    assert [marker["colorscale"][n][0] for n in (0, -1)] == [0.0, 1.0]


def test_coloured_cloud_can_also_be_shown_by_height(cloud):
    both = plotted(scene_of(cloud))
    colourings = both["layout"]["meta"]
    assert [colouring["label"] for colouring in colourings] == ["image", "height"]
    lengths = {len(unpack(colouring["marker"]["color"])) for colouring in colourings}
    assert lengths == {len(unpack(both["data"][0]["x"]))}
    marker, z = colourings[1]["marker"], unpack(both["data"][0]["z"])
    named = [marker["colorscale"][place][1] for place in unpack(marker["color"])]
    for place, rgb in ((z.argmin(), (48, 18, 59)), (z.argmax(), (122, 4, 3))):
        shown = [int(band) for band in named[place][4:-1].split(",")]
        assert shown == pytest.approx(rgb, abs=1)  # turbo: from dark blue to dark red
    assert colourings[1]["legend"].endswith("m, blue to red")
    plain = PointCloud(cloud.xyz, frame="map")
    assert len(plotted(scene_of(plain))["layout"]["meta"]) == 1


def test_axes_have_true_proportion_whatever_lies_far_away(cloud):
    flat = PointCloud(cloud.xyz * np.array([1.0, 0.5, 0.1], dtype=np.float32))
    layout = plotted(scene_of(flat))["layout"]["scene"]
    sides = {axis: np.ptp(layout[f"{axis}axis"]["range"]) for axis in "xyz"}
    aspect = layout["aspectratio"]
    assert max(aspect.values()) == pytest.approx(2.0)
    assert aspect["y"] / aspect["x"] == pytest.approx(sides["y"] / sides["x"])
    far = np.concatenate([cloud.xyz, [[1e4, 0, 0]]]).astype(np.float32)
    layout = plotted(scene_of(PointCloud(far)))["layout"]["scene"]
    assert np.ptp(layout["xaxis"]["range"]) < 20.0


@pytest.mark.parametrize(
    ("far_m", "eye_m", "expected"),
    [
        # 10 m before the middle of a box of 10.2 m, whose side is 2 units.
        (10.0, (-5.0, 5.0, 5.0), (-2.0 / 1.02, 0.0, 0.0)),
        # Looked at from nearer, in the same direction.
        (1.0, (-9.5, 0.5, 10.5), (-2.2 / 2**0.5, 0.0, 2.2 / 2**0.5)),
    ],
)
def test_eye_in_metres_is_where_the_layout_looks_from(far_m, eye_m, expected):
    corners = np.array([[0, 0, 0], [far_m] * 3], dtype=np.float32)
    scene = plotted(scene_of(PointCloud(corners), eye_m=eye_m))["layout"]["scene"]
    assert tuple(scene["camera"]["eye"].values()) == pytest.approx(expected)


@pytest.mark.parametrize("poses", [None, 3, 0])
def test_scene_of_one_place_is_valid_json_and_one_of_none_is_empty(poses):
    one, empty = (PointCloud(np.zeros((n, 3), dtype=np.float32)) for n in (1, 0))
    path = np.zeros((poses or 0, 3), np.float32)
    paths = () if poses is None else (Points("path", PointCloud(path)),)
    json.dumps(plotted(scene_of(one, paths=paths)), allow_nan=False)
    assert not scene_of(one, paths=paths).empty
    assert scene_of(empty, paths=paths).empty
    assert Scene(paths=paths).empty


def test_a_path_has_one_colour_or_that_of_each_pose(cloud):
    rgb = np.array([[1, 2, 3], [1, 2, 3], [250, 0, 0]], np.uint8)
    ways = [PointCloud(np.eye(3, dtype=np.float32)[:n], rgb[:n]) for n in (2, 3)]
    paths = tuple(Points(f"{n}", way) for n, way in enumerate(ways))
    one, each = (trace["line"] for trace in plotted(scene_of(cloud, paths=paths))["data"][1:])
    assert one["color"] == "rgb(1,2,3)"
    named = [each["colorscale"][place][1] for place in unpack(each["color"])]
    assert named == ["rgb(1,2,3)", "rgb(1,2,3)", "rgb(250,0,0)"]


def drive(angle_deg: float, length_m: float = 300.0) -> PointCloud:
    """A straight street, 16 m wide, between fronts of 7 m."""
    rng, turn = np.random.default_rng(0), np.radians(angle_deg)
    along, aside = rng.uniform(0, length_m, 4000), rng.choice([-8.0, 8.0], 4000)
    x, y = np.cos(turn) * along - np.sin(turn) * aside, np.sin(turn) * along + np.cos(turn) * aside
    return PointCloud(np.stack([x, y, rng.uniform(0, 7, 4000)], axis=1).astype(np.float32))


def seen_places(cloud: PointCloud) -> np.ndarray:
    """Where the points are in the first view: -1 to 1 from border to border, across and up."""
    scene = plotted(scene_of(cloud))["layout"]["scene"]
    box = np.array([scene[f"{axis}axis"]["range"] for axis in "xyz"])
    unit = scene["aspectratio"]["x"] / np.ptp(box[0])
    eye, centre = (np.array(list(scene["camera"][key].values())) for key in ("eye", "center"))
    ahead = (centre - eye) / np.linalg.norm(centre - eye)
    right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(np.cross(ahead, [0, 0, 1]))
    rays = (cloud.xyz - box.mean(axis=1)) * unit - eye
    # plotly's field of view: 45 degrees from bottom to top, here 1.7 times as much across.
    half = np.tan(np.radians(22.5)) * np.array([1.7, 1.0])
    places = np.stack([rays @ right, rays @ np.cross(right, ahead)], axis=1)
    return places / (rays @ ahead)[:, None] / half


@pytest.mark.parametrize("angle_deg", [0, 45, 90, -60, 135])
def test_a_long_drive_fills_the_first_view_whatever_its_direction(angle_deg):
    places = seen_places(drive(angle_deg))
    assert np.abs(places).max() <= 1
    # From one border almost to the other, in one direction at least, and not as a thin strip:
    # seen from its side it would cover 2 % of the view.
    assert np.ptp(places, axis=0).max() > 1.6
    cells = np.unique(np.floor((places + 1) * 12), axis=0)
    assert len(cells) > 0.1 * 24**2


@given(count=st.integers(0, 400), limit=st.integers(1, 100), seed=st.integers(0, 99))
def test_thinned_cloud_is_a_part_of_the_cloud_within_the_limit(count, limit, seed):
    xyz = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
    thinned = thin_cloud(PointCloud(xyz), limit).xyz
    assert len(thinned) == count if count <= limit else 0 < len(thinned) <= limit
    assert {tuple(p) for p in thinned.tolist()} <= {tuple(p) for p in xyz.tolist()}


def test_thinned_cloud_keeps_its_extent_and_most_of_what_it_may(cloud):
    thinned = thin_cloud(cloud, 500)
    (trace,) = plotted(scene_of(cloud), 500)["data"]
    assert len(unpack(trace["x"])) == len(thinned)
    # A cell may not be much larger than needed, or detail would be lost for nothing.
    assert 250 <= len(thinned) <= 500
    assert np.ptp(thinned.xyz, axis=0) == pytest.approx(np.ptp(cloud.xyz, axis=0), abs=1.0)
    assert thinned.rgb is not None
    np.testing.assert_array_equal(thinned.xyz, thin_cloud(cloud, 500).xyz)
    assert len(thin_cloud(PointCloud(np.ones((50, 3), dtype=np.float32)), 10)) == 1


def test_thinned_mesh_covers_the_same_place_with_fewer_triangles(mesh):
    assert thin_mesh(mesh, 10_000) is mesh
    thinned = thin_mesh(mesh, 200)
    assert 20 < len(thinned.faces) <= 200
    assert thinned.faces.max() < len(thinned.vertices)
    assert (np.diff(np.sort(thinned.faces, axis=1), axis=1) > 0).all()
    # The sheet is 19 m wide; cells of a few metres move its border by less than one cell.
    assert np.ptp(thinned.vertices, axis=0)[:2] == pytest.approx([19, 19], abs=4)
    assert len(thinned.rgb) == len(thinned.vertices)


@given(count=st.integers(0, 300), seed=st.integers(0, 99))
def test_palette_is_small_and_every_colour_is_near_its_entry(count, seed):
    rgb = np.random.default_rng(seed).integers(0, 256, (count, 3), dtype=np.uint8)
    palette, index = quantise_colours(rgb)
    assert 1 <= len(palette) <= 256
    assert len(index) == count
    if count:
        # 300 random colours in 256 entries: few share one, and those are close.
        assert np.abs(palette[index].astype(int) - rgb).mean() < 16


@pytest.mark.parametrize(
    ("rgb", "off"),
    [
        (np.repeat(np.arange(256)[:, None], 3, axis=1), 1),
        (np.array([[0, 0, 0]] * 3 + [[200, 10, 10]] * 97), 0),
    ],
)
def test_greys_and_two_colours_of_unequal_number_stay(rgb, off):
    palette, index = quantise_colours(rgb.astype(np.uint8))
    assert np.abs(palette[index].astype(int) - rgb).max() <= off

"""The picture of a surface shows what images saw there, whichever they were and how exposed."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from recon.core.errors import MeshingError
from recon.core.geometry.se3 import T_YUP_FRAME, apply, exp_so3, invert, make_transform
from recon.core.values import RectifiedCamera, TriangleMesh
from recon.core.values.camera import project, unproject
from recon.export.mesh import charts
from recon.export.mesh.charts import make_atlas, ratios_of, texels_of
from recon.export.mesh.cut import vertex_normals
from recon.export.mesh.texture import textured_mesh
from recon.export.mesh.views import PosedImage
from recon.export.product import DriveImages
from recon.io.images.image import write_image
from recon.io.models.mesh import Photo, write_mlp

CAMERA = RectifiedCamera(
    focal_px=200.0, cx_px=159.5, cy_px=119.5, cx_right_px=159.5, baseline_m=0.1,
    width_px=320, height_px=240,
)  # fmt: skip
EDGE_M = 0.1
T_MAP_CAMERA = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])  # ahead


def colour_at(xyz: np.ndarray) -> np.ndarray:
    """The true colours (N, 3): waves finer than a triangle, red along x and green along y."""
    x, y, z = xyz.T
    waves = [np.sin(2 * np.pi * x / 0.3), np.sin(2 * np.pi * (y + z) / 0.3), np.sin(x + y)]
    return 120 + 60 * np.stack(waves, axis=1)


def ground(rise: float = 0.1) -> TriangleMesh:
    """A slope of 5 m by 3 m ahead, of triangles of 0.1 m, with a grey of its own."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(1, 6, 0.1), np.arange(-1.5, 1.5, 0.1)))
    corner = (np.arange(29)[:, None] * 50 + np.arange(49)).ravel()
    around = (corner, corner + 1, corner + 51), (corner, corner + 51, corner + 50)
    faces = np.concatenate([np.stack(one, axis=1) for one in around]).astype(np.int32)
    vertices = np.stack([x, y, rise * x], axis=1).astype(np.float32)
    rgb = np.full(vertices.shape, 120, np.uint8)
    return TriangleMesh(vertices, faces, vertex_normals(vertices, faces), rgb)


def fused() -> TriangleMesh:
    """The slope, whose vertices have their true colours."""
    mesh = ground()
    return replace(mesh, rgb=np.rint(colour_at(mesh.vertices)).astype(np.uint8))


def photograph(number: int, x: float, y: float, gain: float = 1.0, rise: float = 0.1) -> PosedImage:
    """What a camera 1 m up and 25° down sees of the slope."""
    tilt = make_transform(exp_so3(np.array([-np.deg2rad(25), 0, 0])), np.zeros(3))
    T_map_camera = make_transform(np.eye(3), np.array([x, y, 1.0])) @ T_MAP_CAMERA @ tilt
    row, column = (axis.ravel() for axis in np.indices((240, 320)))
    rays = unproject(column, row, np.ones(len(row)), CAMERA) @ T_map_camera[:3, :3].T
    eye = T_map_camera[:3, 3]
    depth = (rise * eye[0] - eye[2]) / (rays[:, 2] - rise * rays[:, 0])
    rgb = gain * colour_at(eye + np.where(depth > 0, depth, 0)[:, None] * rays)
    image = np.clip(np.rint(rgb), 0, 255).astype(np.uint8).reshape(240, 320, 3)
    return PosedImage(number, image, CAMERA, T_map_camera)


def painted(mesh: TriangleMesh, views: list[PosedImage], most_px: int = 4096):
    """The texture at the middle of each face: its places there, and its colours (F, 3)."""
    textured, figures = textured_mesh(mesh, lambda: views, EDGE_M, 20.0, most_px)
    picture = textured.texture.image
    middle = textured.texture.uv[textured.faces].mean(axis=1) * picture.shape[1::-1]
    column, row = np.floor(middle).astype(int).T
    places = textured.vertices[textured.faces].mean(axis=1)
    return places, picture[row, column].astype(float), figures


def test_the_picture_shows_what_is_finer_than_triangles():
    views = [photograph(n, x, 0.0) for n, x in enumerate((0.0, 0.5, 1.0, 2.0))]
    places, rgb, figures = painted(ground(), views)
    near = (places[:, 0] > 2.5) & (places[:, 0] < 4) & (np.abs(places[:, 1]) < 0.8)
    # A wave of 0.3 m has a level of each pixel of 5 to 10 mm that differs by some of 60.
    assert np.abs(rgb - colour_at(places))[near].mean() < 8
    assert rgb[near].std(axis=0)[:2].min() > 30
    assert figures.textured > 0.8
    assert 0.002 < figures.texel_m < 0.02


def test_exposures_are_evened_and_those_of_the_fused_points():
    gains = (1.3, 0.7, 1.2, 0.8)
    views = [photograph(n, 0.5 * n, 0.0, gain) for n, gain in enumerate(gains)]
    places, rgb, _ = painted(fused(), views)
    near = (places[:, 0] > 2.5) & (places[:, 0] < 4.5) & (np.abs(places[:, 1]) < 0.8)
    off = rgb[near] / colour_at(places[near])
    assert np.median(off) == pytest.approx(1, rel=0.05)
    # Without gains they differ by a half and more from one image to the next.
    halves = [np.median(off[(x := places[near][:, 0]) < 3.5]), np.median(off[x >= 3.5])]
    assert halves[0] == pytest.approx(halves[1], rel=0.05)


def test_exposures_are_evened_where_the_surface_has_no_colours():
    gains = (1.3, 0.7, 1.2, 0.8)
    views = [photograph(n, 0.5 * n, 0.0, gain) for n, gain in enumerate(gains)]
    places, rgb, figures = painted(replace(ground(), rgb=None), views)
    near = (places[:, 0] > 2.5) & (places[:, 0] < 4.5) & (np.abs(places[:, 1]) < 0.8)
    off = rgb[near] / colour_at(places[near])
    # Nothing says how bright the surface is: as the images are, in the mean.
    assert np.median(off) == pytest.approx(np.exp(np.mean(np.log(gains))), rel=0.05)
    assert np.percentile(off, 90) / np.percentile(off, 10) < 1.3
    assert 0.5 < figures.textured <= 1


def test_what_passed_by_in_one_image_is_not_painted():
    views = [photograph(n, 0.05 * n, 0.0) for n in range(4)]
    passed = views[3].image.copy()  # the nearest
    passed[100:220, 100:220] = 255
    views[3] = views[3]._replace(image=passed)
    places, rgb, _ = painted(fused(), views)
    u, v, _ = project(apply(invert(views[3].T_map_camera), places), CAMERA)
    hidden = (np.abs(u - 160) < 50) & (np.abs(v - 160) < 50)
    # White would count for a third; half of its 135 levels is what it takes to be seen.
    assert np.median((rgb - colour_at(places))[hidden]) < 10


def test_what_is_behind_something_is_not_painted_with_it():
    mesh = ground()
    # A board across the view, 0.5 m before a camera that alone sees what is behind.
    y, z = np.meshgrid(np.linspace(-1, 1, 20), np.linspace(0.2, 1.5, 20))
    board = np.stack([np.full(400, 1.0), y.ravel(), z.ravel()], axis=1).astype(np.float32)
    corner = (np.arange(19)[:, None] * 20 + np.arange(19)).ravel()
    around = (corner, corner + 20, corner + 1), (corner + 1, corner + 20, corner + 21)
    faces = np.concatenate([np.stack(one, axis=1) for one in around]).astype(np.int32)
    vertices = np.concatenate([mesh.vertices, board])
    faces = np.concatenate([mesh.faces, faces + np.int32(len(mesh.vertices))])
    rgb = np.full(vertices.shape, 50, np.uint8)
    both = TriangleMesh(vertices, faces, vertex_normals(vertices, faces), rgb)
    red = np.full((240, 320, 3), [255, 0, 0], np.uint8)
    view = photograph(0, 0.5, 0.0)._replace(image=red)
    places, found, _ = painted(both, [view])
    behind = (places[:, 0] > 2) & (places[:, 0] < 4) & (np.abs(places[:, 1]) < 0.5)
    np.testing.assert_array_equal(np.unique(found[behind]), [50])
    board = found[(places[:, 0] < 1.01) & (np.abs(places[:, 2] - 0.8) < 0.1)]
    red = board[board[:, 1] == 0]
    assert len(red) > len(board) / 3  # the rest is beside the image, or at its edge
    # As bright as the fused points.
    np.testing.assert_allclose(red, np.tile([3 * 50, 0, 0], (len(red), 1)), atol=2)


def test_an_image_that_sees_nothing_of_the_surface_changes_nothing():
    view = photograph(0, 0.5, 0.0)
    behind = view.T_map_camera @ make_transform(exp_so3(np.array([0, np.pi, 0])), np.zeros(3))
    away = photograph(1, 0.5, 0.0)._replace(T_map_camera=behind)
    expected, found = painted(ground(), [view]), painted(ground(), [view, away])
    np.testing.assert_array_equal(found[1], expected[1])


class Drawn(DriveImages):
    """A drive whose images are of one value, the number of their frame."""

    def rectified(self, pair):
        return (np.full((10, 10), pair, np.uint8),)


def test_images_that_fit_into_memory_are_read_once(monkeypatch):
    monkeypatch.setattr("recon.export.product._KEPT_BYTES", 250)
    read, placed = [], np.array([False, True, True, False, True])

    def frames(start):
        for frame in range(start, len(placed)):
            read.append(frame)
            yield frame

    drive = Drawn(None, placed, "", SimpleNamespace(frames=frames), None)
    for again in ([1, 2, 3, 4], [3, 4]):
        read.clear()
        seen = [(frame, int(left[0, 0])) for frame, (left,) in drive.views()]
        assert seen == [(1, 1), (2, 2), (4, 4)]
        assert read == again


def test_charts_do_not_overlap_and_keep_lengths():
    angle = np.random.default_rng(0).permutation(np.linspace(0, 2 * np.pi, 60, endpoint=False))
    sphere = np.array([[np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)]
                       for b in np.linspace(-1.4, 1.4, 30) for a in np.sort(angle)])  # fmt: skip
    row, column = np.divmod(np.arange(29 * 60), 60)
    a, b = 60 * row + column, 60 * row + (column + 1) % 60
    faces = np.concatenate([np.stack([a, b, b + 60], 1), np.stack([a, b + 60, a + 60], 1)])
    mesh = TriangleMesh(sphere.astype(np.float32), faces.astype(np.int32))
    atlas = make_atlas(mesh, 0.01, 4096)
    numbers, found = texels_of(atlas)
    assert {*found.tolist()} == {*range(len(faces))}
    ratios = ratios_of(atlas, numbers, found)
    np.testing.assert_allclose(ratios.sum(axis=1), 1, atol=1e-5)
    # What a texel shows is on the face at the texel's place in the chart, and on the sphere.
    at = np.einsum("nc,ncd->nd", ratios, atlas.places[atlas.mesh.faces[found]])
    texels = np.stack([numbers % atlas.width_px, numbers // atlas.width_px], axis=1) + 0.5
    assert np.abs(at - texels).max() < 0.01
    edges = atlas.mesh.faces[:, [0, 1]]
    flat = np.linalg.norm(np.subtract(*atlas.places[edges].transpose(1, 0, 2)), axis=1) * 0.01
    true = np.linalg.norm(np.subtract(*atlas.mesh.vertices[edges].transpose(1, 0, 2)), axis=1)
    assert (flat <= true + 1e-5).all()
    assert np.median(flat / true) > 0.8
    np.testing.assert_array_equal(mesh.vertices[atlas.vertex_of], atlas.mesh.vertices)


def test_texels_grow_until_the_picture_fits():
    views = [photograph(0, 0.0, 0.0)]
    _, _, figures = painted(ground(), views, most_px=128)
    assert figures.texture_px <= 128
    assert figures.texel_m > 5 / 128


def test_a_picture_too_small_for_the_charts_is_an_error():
    # Each of 200 patches has a chart of its own, and its margins alone fill the picture.
    mesh, steps = ground(), np.arange(200)[:, None]
    apart = np.concatenate([mesh.vertices[mesh.faces[0]] + np.float32([0, 0.01, 0]) * steps[k]
                            for k in range(200)])  # fmt: skip
    faces = np.arange(600, dtype=np.int32).reshape(-1, 3)
    with pytest.raises(MeshingError, match=r"does not fit .*texture_px \(64\)"):
        make_atlas(TriangleMesh(apart.astype(np.float32), faces), 0.01, 64)


def test_a_surface_that_no_image_sees_is_an_error():
    with pytest.raises(MeshingError, match="no image of the drive sees the surface"):
        painted(ground(), [photograph(0, 50.0, 0.0)])


def test_meshlab_sees_a_point_of_the_map_where_the_image_does(tmp_path):
    view = photograph(0, 0.7, 0.3)
    write_image(tmp_path / "left.png", view.image)
    (tmp_path / "mesh.ply").write_text("ply\n")
    photo = Photo(tmp_path / "left.png", CAMERA, view.T_map_camera)
    write_mlp(tmp_path / "mesh.mlp", {"mesh": tmp_path / "mesh.ply"}, "map", [photo])
    written = re.findall(r'(\w+)="([-\d. e]+)"', (tmp_path / "mesh.mlp").read_text())
    values = {name: np.array(text.split(), float) for name, text in written}
    xyz = np.random.default_rng(0).uniform([2, -1, 0], [4, 1, 1], (20, 3))
    turned = values["RotationMatrix"].reshape(4, 4)[:3, :3]
    seen = (apply(T_YUP_FRAME["map"], xyz) + values["TranslationVector"][:3]) @ turned.T
    focal = values["FocalMm"] / values["PixelSizeMm"]
    column, row = (seen[:, :2] / -seen[:, 2:] * focal + values["CenterPx"]).T
    u, v, _ = project(apply(invert(view.T_map_camera), xyz), CAMERA)
    np.testing.assert_allclose(column - 0.5, u, atol=1e-3)
    np.testing.assert_allclose(240 - 0.5 - row, v, atol=1e-3)


def test_an_exposure_that_changes_along_the_drive_is_evened_though_the_fused_points_are_not():
    # The colours of vertices have what the drive had there: half at its start, twice at its end.
    mesh, gains = fused(), np.geomspace(0.6, 1.4, 9)
    there = np.interp(mesh.vertices[:, 0], [1.5, 5], [0.6, 1.4])[:, None]
    mesh = replace(mesh, rgb=np.rint(there * mesh.rgb).clip(0, 255).astype(np.uint8))
    views = [photograph(n, 0.3 * n, 0.0, gain) for n, gain in enumerate(gains)]
    places, rgb, _ = painted(mesh, views)
    near = (places[:, 0] > 2) & (places[:, 0] < 5) & (np.abs(places[:, 1]) < 0.6)
    off = rgb[near] / colour_at(places[near])
    x = places[near][:, 0]
    first, last = np.median(off[x < 3]), np.median(off[x > 4])
    assert first == pytest.approx(last, rel=0.05)


def test_what_is_beside_an_outline_is_not_painted_on_what_is_behind():
    # A post of 3 cm, less than a triangle, half a metre before the slope, red in all images.
    mesh = ground()
    y, z = np.meshgrid([-0.015, 0.015], np.linspace(0.2, 1.5, 40))
    post = np.stack([np.full(80, 2.5), y.ravel(), z.ravel()], axis=1).astype(np.float32)
    corner = np.arange(0, 78, 2)
    around = (corner, corner + 2, corner + 1), (corner + 1, corner + 2, corner + 3)
    faces = np.concatenate([np.stack(one, axis=1) for one in around]).astype(np.int32)
    vertices = np.concatenate([mesh.vertices, post])
    faces = np.concatenate([mesh.faces, faces + np.int32(len(mesh.vertices))])
    rgb = np.full(vertices.shape, 120, np.uint8)
    both = TriangleMesh(vertices, faces, vertex_normals(vertices, faces), rgb)
    views = []
    for n, y_m in enumerate((-0.5, 0.0, 0.5)):
        view = photograph(n, 0.5, y_m)
        u, v, _ = project(apply(invert(view.T_map_camera), post.astype(float)), CAMERA)
        image = view.image.copy()
        image[: int(v.max()) + 2, int(u.min()) : int(u.max()) + 2] = [255, 0, 0]
        views.append(view._replace(image=image))
    places, found, _ = painted(both, views)
    slope = (np.abs(places[:, 2] - 0.1 * places[:, 0]) < 1e-3) & (places[:, 0] > 3)
    behind = slope & (places[:, 0] < 4) & (np.abs(places[:, 1]) < 0.6)
    red = (found[:, 0] > 100) & (found[:, 1] < 30)
    assert behind.sum() > 100
    assert not red[behind].any()
    assert np.median(np.abs(found - colour_at(places))[behind]) < 15
    assert red[(np.abs(places[:, 0] - 2.5) < 1e-3) & (np.abs(places[:, 1]) < 0.02)].any()


def test_crumbs_of_a_rough_surface_join_larger_charts_and_hide_nothing():
    mesh, random = ground(), np.random.default_rng(0)
    rough = mesh.vertices + random.normal(0, 0.08, mesh.vertices.shape).astype(np.float32)
    mesh = replace(mesh, vertices=rough)
    atlas = make_atlas(mesh, 0.01, 4096)
    surface = charts._directions(mesh)
    own, joined = charts._kinds(mesh, surface, 0.01)
    before, after = (len(np.unique(charts._charts(surface.pairs, k))) for k in (own, joined))
    assert after < 0.8 * before
    overlapping = charts._laid_out(mesh, surface.pairs, joined, 0.01)
    assert hidden_faces(atlas) < hidden_faces(overlapping) / 2


def hidden_faces(atlas: charts.Atlas) -> int:
    _, found = texels_of(atlas)
    shown, area = np.bincount(found, minlength=len(atlas.mesh.faces)), np.abs(atlas.sides[-1]) / 2
    return int(((area > 20) & (shown < 0.5 * area)).sum())

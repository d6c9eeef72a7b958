"""The picture of a view in 3-D, for paper, and pages as a browser shows and prints them."""

import io

import numpy as np
import pytest
from PIL import Image

from recon.core.values import PointCloud
from recon.report import style
from recon.report.scene import Points, Scene
from recon.report.view3d import draw_still, view_of
from tests.report.test_pages import pair_html, scene_page, some_html
from tests.scenery import chromium

RED, BLUE = (250, 10, 10), (10, 10, 250)


def wall(x_m: float, half_m: float, rgb: tuple[int, int, int]) -> PointCloud:
    """Points on a square across x, closer to each other than the squares that stand for them."""
    side = np.linspace(-half_m, half_m, 160)
    y, z = np.meshgrid(side, side)
    xyz = np.stack([np.full(y.size, x_m), y.ravel(), z.ravel()], axis=1).astype(np.float32)
    return PointCloud(xyz, rgb=np.tile(np.uint8(rgb), (len(xyz), 1)))


def still(*clouds: PointCloud, **more: object) -> tuple[np.ndarray, str]:
    xyz, rgb = (np.concatenate([getattr(c, name) for c in clouds]) for name in ("xyz", "rgb"))
    cloud = Points("cloud", PointCloud(xyz, rgb=rgb))
    return drawn(Scene((cloud,), eye_m=(-6.0, 0.0, 0.0), **more))  # type: ignore[arg-type]


def drawn(scene: Scene) -> tuple[np.ndarray, str]:
    with Image.open(io.BytesIO(draw_still(view_of(scene, 120_000)))) as image:
        return np.asarray(image), image.info[style.SEEN]


def test_what_is_near_hides_what_is_far_and_nothing_is_drawn_around():
    near, far = wall(0.0, 1.0, RED), wall(6.0, 4.0, BLUE)
    for order in ((near, far), (far, near)):
        image, seen = still(*order)
        rows, columns = image.shape[0] // 2, image.shape[1] // 2
        assert tuple(image[rows, columns]) == (*RED, 255)
        assert tuple(image[rows, 20]) == (*BLUE, 255)
        assert max(image.shape) > 600
        assert seen.startswith("View in 3-D of cloud (51,200 of 51,200 points), in a box of")
    image, _ = still(far.select(far.xyz[:, 1] + far.xyz[:, 2] > 0))
    assert (image[image[..., 3] == 255][:, 2] > 200).all()
    assert (image[..., 3] == 0).mean() > 0.3


def test_paths_are_upon_all_and_one_of_no_frame_is_left_out():
    way = np.array([[3.0, -2.0, 0.0], [3.0, 2.0, 0.0]], np.float32)  # behind the red wall
    found = PointCloud(way, np.tile(np.uint8([255, 82, 82]), (2, 1)))
    paths = (Points("path", found), Points("nowhere", PointCloud(way[:0])))
    image, seen = still(wall(0.0, 1.0, RED), wall(6.0, 4.0, BLUE), paths=paths)
    middle = image[image.shape[0] // 2 + np.arange(-9, 10), image.shape[1] // 2, :3]
    assert (middle == (255, 82, 82)).all(axis=1).any()
    assert "path, in a box" in seen


def test_a_mesh_alone_and_a_scene_of_one_point_have_a_picture(mesh):
    one = PointCloud(np.zeros((1, 3), np.float32))
    image, _ = drawn(Scene((Points("cloud", one),)))
    assert (image[..., 3] == 255).any()
    image, _ = drawn(Scene(mesh=mesh))
    assert (image[image[..., 3] == 255] == (90, 90, 90, 255)).all()  # its own colour


SCREEN = {"height": 900, "deviceScaleFactor": 1, "mobile": False}
SHOWN = """(() => {
    const look = (name) => getComputedStyle(document.querySelector(name));
    return [look(".still").display, look(".scene").display, look(".ink").filter,
            look(".picture").filter];
})()"""


def comes(page: chromium.Page, script: str) -> bool:
    """Wait until something is true in a page."""
    return any(page.run(script) or page.wait(0.5) for _ in range(120))


@pytest.mark.slow
@pytest.mark.skipif(chromium.PROGRAM is None, reason="Chromium is not installed")
def test_a_browser_prints_the_still_darkens_ink_alone_and_says_what_goes_on(view, tmp_path):
    (tmp_path / "page.html").write_text(pair_html(view), encoding="utf-8")
    with chromium.opened(tmp_path / "profile") as page:
        page.emulate("setDeviceMetricsOverride", width=1400, **SCREEN)
        page.open((tmp_path / "page.html").as_uri())
        assert comes(page, "!!document.querySelector('.drawn canvas')")
        assert page.run(SHOWN) == ["none", "block", "none", "none"]
        page.emulate("setEmulatedMedia", media="print")
        assert page.run(SHOWN)[:2] == ["block", "none"]
        dark = [{"name": "prefers-color-scheme", "value": "dark"}]
        page.emulate("setEmulatedMedia", media="screen", features=dark)
        assert page.run(SHOWN)[2:4] == ["invert(1) hue-rotate(180deg)", "none"]
        page.emulate("setDeviceMetricsOverride", width=400, **SCREEN)
        assert comes(page, "document.querySelectorAll('.cut').length > 0")
        page.run("document.querySelectorAll('.scroll').forEach((one) => one.scrollTo(9999, 0))")
        assert comes(page, "document.querySelectorAll('.cut').length == 0")
        assert page.errors == []


def test_a_view_has_its_still_a_role_and_a_name_and_figures_are_folded(view):
    page = scene_page(Scene((Points("cloud", view.cloud),)))
    assert page.count('class="still" alt="View in 3-D of cloud (2,000 of 2,000 points)') == 1
    assert 'class="scene" role="img" aria-label="View in 3-D of cloud' in page
    inside = pair_html(view).partition('<details class="wide"><summary>All figures</summary>')[2]
    assert 0 < inside.index("points: 2000") < inside.index("</details>")


def test_an_image_without_notes_is_a_picture_that_its_title_names():
    page = some_html()
    assert 'class="picture" alt="Image plain" src="data:image/webp' in page
    assert 'class="ink"' not in page

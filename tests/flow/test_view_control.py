"""Control points are clicked in keyframes, and what is off there is said at once."""

import re

import numpy as np
import pytest

from recon.commands import view
from recon.core.errors import EvaluationError, ReconError
from recon.core.geometry.se3 import apply, invert
from recon.core.values.camera import project
from recon.map.sessions.measured import Survey
from recon.view.follow import finish
from tests.flow.test_control_points import HEAD, T_SURVEY_TRUE, rows  # noqa: F401 - a fixture

pytest.importorskip("pyproj")
DEPTH_M = 0.1


@pytest.fixture
def survey(rows, tmp_path):  # noqa: F811
    file = tmp_path / "gcp_list.txt"
    file.write_text("\n".join([HEAD, *rows]) + "\n")
    return Survey(file)


@pytest.fixture
def views(small_demo, survey):
    return next(finish(small_demo, view.read_products(small_demo), survey)).keyframes


def clicked(views, name: str, number: int, off_px=(0.0, 0.0)) -> list[str]:
    """What a click says at where a keyframe has the control point, some pixels aside."""
    T, camera = views.T_map_camera[number], views._camera(number)
    u, v, _ = (each[0] for each in project(apply(invert(T), views.points[name][None]), camera))
    at = (u + off_px[0] - camera.cx_px, v + off_px[1] - camera.cy_px, camera.focal_px)
    eye = T[:3, 3] - 0.05 * T[:3, 2]  # somebody went back a little to see more of the image
    on_image = T[:3, 3] + DEPTH_M * T[:3, :3] @ (np.array(at) / camera.focal_px)
    ray = on_image - eye
    views.look(number)
    return views.mark(name, number, np.stack([eye, ray / np.linalg.norm(ray)]), DEPTH_M)


def numbers(lines: list[str]) -> list[float]:
    return [float(re.search(r": ([-+]?\d+\.\d+)", line)[1]) for line in lines[1:]]


def test_control_points_are_where_the_map_has_them(views):
    assert len(views.points) >= 5
    for place_m in views.points.values():
        assert views.sees(0, place_m)


def test_a_click_at_a_point_says_that_it_is_where_it_was_surveyed(views):
    for name in views.points:
        title, east, north, up, frame = clicked(views, name, 0)
        assert title == f"{name}, map minus survey:"
        assert (east[:6], north[:6], up[:4]) == ("East: ", "North:", "Up: ")
        for line in (east, north, up):
            off_m, sigma_m = map(float, re.search(r"([-+][\d.]+) ± ([\d.]+) m", line).groups())
            assert sigma_m >= 0.02
            assert abs(off_m) < 4 * sigma_m
        assert re.fullmatch(r"Frame 0: 0\.\d\d px off", frame)


def test_clicks_in_two_keyframes_that_contradict_each_other_are_so_many_pixels_off(views):
    name = next(name for name, place in views.points.items() if views.sees(1, place))
    clicked(views, name, 0)
    together = clicked(views, name, 1)
    assert [line.partition(":")[0] for line in together[4:]] == [
        f"Frame {views._views.keys[number][1]}" for number in (0, 1)
    ]
    assert max(numbers(together)[3:]) < 1.0
    apart = clicked(views, name, 1, off_px=(0.0, 6.0))
    assert len(apart) == len(
        together
    )  # a later click in an image takes the place of the one before
    assert min(numbers(apart)[3:]) > 1.5


def test_a_point_that_was_surveyed_wrongly_is_off_by_that(small_demo, rows, tmp_path):  # noqa: F811
    name = rows[0].split()[6]
    file = tmp_path / "gcp_list.txt"
    wrong = [
        re.sub(r"^(\S+ \S+) \S+", rf"\1 {float(row.split()[2]) + 1.5:.4f}", row) + " check"
        if row.split()[6] == name
        else row
        for row in rows
    ]
    file.write_text("\n".join([HEAD, *wrong]) + "\n")
    views = next(finish(small_demo, view.read_products(small_demo), Survey(file))).keyframes
    image_of = Survey(file).control.points[0].seen[0][1]
    views.look(0)
    camera, T = views._camera(0), views.T_map_camera[0]
    at = np.array([*(image_of - [camera.cx_px, camera.cy_px]), camera.focal_px])
    ray = np.stack([T[:3, 3], T[:3, :3] @ at / np.linalg.norm(at)])
    lines = views.mark(name, 0, ray, DEPTH_M)
    assert numbers(lines)[2] == pytest.approx(-1.5, abs=0.2)


def test_a_ray_beside_the_image_or_away_from_it_is_no_click_at_the_point(views):
    name, T = next(iter(views.points)), views.T_map_camera[0]
    views.look(0)
    for direction in ((-1, 0, 0.1), (0, 0, -1), (0, 1, 0), (0, 0, 0)):
        ray = np.stack([T[:3, 3], T[:3, :3] @ np.array(direction, np.float64)])
        assert views.mark(name, 0, ray, DEPTH_M) == []


def test_positions_of_a_drive_are_refused(small_demo, tmp_path):
    file = tmp_path / "positions.txt"
    file.write_text("0 1 2 3\n1 2 3 4\n")
    with pytest.raises(EvaluationError, match="cannot be clicked"):
        view.run_view([small_demo], 0, print, lambda: True, Survey(file))
    file.unlink()
    with pytest.raises(ReconError, match="does not exist"):
        view.run_view([small_demo], 0, print, lambda: True, Survey(file))

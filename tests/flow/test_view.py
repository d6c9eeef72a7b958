"""Maps in the browser: of a finished run, of one that grows, and what is refused."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import urlopen

import numpy as np
import pytest

from recon.commands import view
from recon.commands.config import load_config, run_settings
from recon.commands.demo import demo_source
from recon.commands.localize import run_localize
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.progress import Counted, Silent, showing
from recon.io.models.ply import read_ply
from recon.io.models.rasters import read_grid
from recon.report.scene import colours
from recon.run.directory import STARTED, state_folder
from recon.run.finished import figure_of
from recon.view.follow import add_located, finish, follow_located, grow
from tests.flow.conftest import SMALL_STREET
from tests.hostile.refusals import assert_refused, run
from tests.scenery import chromium

VIEW = [sys.executable, "-m", "recon", "view"]


@pytest.fixture(scope="module")
def scenes(small_demo):
    return list(finish(small_demo, view.read_products(small_demo)))


def test_a_finished_run_shows_all_points_of_its_cloud_its_grid_path_and_drift(small_demo, scenes):
    whole, scene = read_ply(small_demo / "map/cloud.ply"), scenes[-1]
    shown = np.concatenate([part.cloud.xyz for part in scene.points])
    assert sorted(map(tuple, shown.tolist())) == sorted(map(tuple, whole.xyz.tolist()))
    (path,), ((grid, ground),) = scene.paths, scene.grids
    assert len(path.cloud) == 12
    below_m = path.cloud.xyz[:, 2] - ground.height_at(path.cloud.xyz[:, :2])
    np.testing.assert_allclose(below_m, figure_of(small_demo, "camera_height_m"), atol=0.2)
    made = read_grid(small_demo / "map/grid.yaml")
    np.testing.assert_array_equal(grid.cells, made.cells)
    assert f"Points in the map: {len(whole):,}" in scene.lines
    assert not [line for line in scene.lines[1:] if "_" in line.partition(":")[0]]  # no keys
    drift, path_m = (
        next(line for line in scene.lines if name in line) for name in ("drift", "Path")
    )
    assert re.fullmatch(r"Expected drift: [\d.]+ %", drift)
    assert re.fullmatch(r"Path: [\d.,]+ m", path_m)
    assert re.fullmatch(r"Drive 0: synthetic street 0( \d{4}-\d\d-\d\d)?", scene.lines[-1])


def test_points_know_the_drive_and_time_that_passed_nearest(scenes):
    scene = scenes[-1]
    (path,) = scene.paths
    for part in scene.points:
        assert (part.values("session") == 0).all()
        near = np.linalg.norm(part.cloud.xyz[:, None] - path.cloud.xyz, axis=2).argmin(axis=1)
        np.testing.assert_array_equal(part.values("age"), path.values("age")[near])


@pytest.mark.parametrize("by", ["image", "height", "sigma", "age", "session"])
def test_every_colouring_colours_every_point(scenes, by):
    found, legend = colours(scenes[-1].points, by)
    assert [len(rgb) for rgb in found] == [len(part.cloud) for part in scenes[-1].points]
    assert {rgb.dtype for rgb in found} == {np.dtype(np.uint8)}
    assert (" to " in legend) == (by in ("height", "sigma", "age"))


def test_keyframes_see_what_is_before_them_and_not_what_is_behind_them_or_hidden(scenes):
    views = scenes[-1].keyframes
    T = views.T_map_camera[0]

    def ahead(metres: float) -> np.ndarray:
        return (T @ [0.0, 0.0, metres, 1.0])[:3]

    assert views.sees(0, ahead(3.0))
    assert not views.sees(0, ahead(-3.0))
    below = (T @ [0.0, 20.0, 30.0, 1.0])[:3]  # through the road
    assert not views.sees(0, below)


def test_a_keyframe_is_matched_again_where_its_images_are_at_hand(scenes, monkeypatch):
    views = scenes[-1].keyframes
    lines, image = views.look(0)
    assert image.shape == (3 * 96, 256, 3)
    assert any(line.startswith("measured ") for line in lines)
    views._opened.clear()
    monkeypatch.setattr("recon.view.follow.open_images", refuse)
    lines, image = views.look(0)
    assert image is None
    assert lines[-1] == "no images: the drive is gone"


def refuse(_: object) -> None:
    from recon.core.errors import SourceError

    raise SourceError("the drive is gone")


def test_a_located_drive_is_shown_in_its_map(small_demo, tmp_path):
    assert view.map_of(small_demo) == small_demo
    config = run_settings(small_demo)
    run_localize(
        demo_source(config), small_demo, config, MapOptions("localize", tmp_path / "there")
    )
    assert view.map_of(tmp_path / "there") == small_demo
    scene = add_located(
        next(finish(small_demo, view.read_products(small_demo))), tmp_path / "there"
    )
    own, found = scene.paths
    assert re.search(r"there: \d+ of 12 frames located", scene.lines[-1])
    near = np.linalg.norm(found.cloud.xyz[:, None] - own.cloud.xyz, axis=2).min(axis=1)
    assert near.max() < 0.2
    assert {tuple(rgb) for rgb in found.cloud.rgb.tolist()} <= {(255, 167, 38), (67, 200, 90)}
    # Seconds since the first frame.
    ages_s = found.values("age")
    assert (np.diff(ages_s) > 0).all()
    np.testing.assert_allclose(ages_s, np.rint(10 * ages_s) / 10, atol=1e-6)
    assert 0 <= ages_s[0] < ages_s[-1] < 1.2


class Watching(Silent):
    """A progress that looks at the map after each frame, as a viewer does beside it."""

    def __init__(self) -> None:
        self.coming, self.seen = None, []

    def begin(self, folder: Path) -> None:
        self.coming = grow(folder, state_folder(folder) / STARTED)

    def on_step(self, step: object) -> None:
        if not isinstance(step, Counted):
            self.seen.append(next(self.coming))


def test_a_path_is_seen_to_grow_while_its_drive_is_located(small_demo, tmp_path):
    class Following(Silent):
        coming, seen = None, []

        def on_step(self, step: object) -> None:
            if not isinstance(step, Counted):
                self.seen.append(next(self.coming))

    following, out, config = Following(), tmp_path / "there", run_settings(small_demo)

    def begin(folder: Path) -> None:
        assert view.map_of(folder) == small_demo
        of_map = next(finish(small_demo, view.read_products(small_demo)))
        following.coming = follow_located([of_map], folder)
        assert len(next(following.coming).paths[1].cloud) == 0

    options = MapOptions("localize", out, begun=begin)
    with showing(following):
        run_localize(demo_source(config), small_demo, config, options)
    counts = [len(scene.paths[1].cloud) for scene in following.seen if scene is not None]
    assert counts == sorted(counts)
    assert len(set(counts)) > 3
    (last,) = following.coming  # it ends, as the run is at its place
    assert len(last.paths[1].cloud) >= counts[-1]
    assert not state_folder(out).exists()


def map_street(out: Path, **how: Any) -> None:
    street = [f"street.{key}={value}" for key, value in SMALL_STREET.items()]
    small = ["checkpoints.every_frames=3", "submaps.length_m=2"]
    config = load_config(None, [*street, *small])
    run_map(demo_source(config), config, MapOptions("demo", out, audit=False, mesh=False, **how))


def test_a_map_is_seen_to_grow_and_is_the_same_map_as_unseen(tmp_path):
    watching = Watching()
    with showing(watching):
        map_street(tmp_path / "seen", begun=watching.begin)
    grown = [scene for scene in watching.seen if scene is not None and scene.points]
    counts = [len(scene.points) for scene in grown]
    assert counts == sorted(counts)
    assert counts[0] < counts[-1]
    assert len(grown[0].paths[0].cloud) < len(grown[-1].paths[0].cloud)
    assert len(grown[-1].grids) == len(grown[-1].points)
    assert grown[-1].points[0] is grown[0].points[0]  # read once
    assert set(watching.coming) <= {None}  # it ends, as the map is at its place
    map_street(tmp_path / "unseen")
    seen, unseen = ((tmp_path / name / "map/cloud.ply").read_bytes() for name in ("seen", "unseen"))
    assert seen == unseen


def test_what_shows_no_map_is_refused_in_one_line(small_demo, tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="the extra view is not installed")
    monkeypatch.setattr(view, "_TURNS", 0)
    assert_refused(run("view", tmp_path), "does not contain a finished run")
    assert_refused(run("view", tmp_path / "missing"), "does not contain a finished run")
    (tmp_path / "run.json").write_text(json.dumps({"command": "pair"}))
    assert_refused(run("view", tmp_path), "made no map")
    damaged = Path(shutil.copytree(small_demo, tmp_path / "damaged"))
    os.truncate(damaged / "map/map.recon", 50_000)
    assert_refused(run("view", damaged, "--port", "0"), "damaged")
    (damaged / "map/map.recon").write_bytes(b"no database")
    assert_refused(run("view", damaged, "--port", "0"), "map.recon")
    (damaged / "map/map.recon").unlink()
    assert_refused(run("view", damaged, "--port", "0"), "folder has no map")


def test_a_taken_port_and_a_missing_package_are_refused_in_one_line(small_demo, monkeypatch):
    pytest.importorskip("viser", reason="the extra view is not installed")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert_refused(run("view", small_demo, "--port", f"{port}"), f"{port}", "another --port")
    monkeypatch.setitem(sys.modules, "viser", None)
    assert_refused(run("view", small_demo), "recon-stereo[view]")


def test_a_viewer_beside_a_run_says_its_secret_address_and_ends_with_it(small_demo):
    """The run is a process that shows itself, waits for a word, and ends."""
    pytest.importorskip("viser", reason="the extra view is not installed")
    code = (
        "import sys; from pathlib import Path; import recon.cli; "
        "cli = sys.modules['recon.cli.view']; "
        f"cli.PORT = 0; cli.view_beside(Path({str(small_demo)!r})); sys.stdin.readline()"
    )
    words, pipe = [sys.executable, "-c", code], subprocess.PIPE
    with subprocess.Popen(words, stdin=pipe, stderr=pipe, text=True) as shown:
        url, *rest = shown.stderr.readline().split()
        assert rest == ["until", "the", "run", "ends"]
        assert asked(url).status == 200
        path = urlsplit(url).path
        commands = [at.read_bytes() for at in Path("/proc").glob("[0-9]*/cmdline")]
        assert not any(path.encode() in one for one in commands)  # `ps` shows them
        shown.stdin.write("\n")
        shown.stdin.flush()
        assert shown.wait(60) == 0
        assert shown.stderr.read() == ""  # closed, as the viewer has ended, too
    with pytest.raises(OSError, match="refused"):
        asked(url)


def asked(url: str) -> Any:
    return urlopen(url, timeout=60)  # noqa: S310 - its own


def test_nothing_that_happens_to_the_viewer_reaches_the_run(tmp_path):
    pytest.importorskip("viser", reason="the extra view is not installed")
    code = (
        "import sys; from pathlib import Path; from recon.cli.view import view_beside; "
        f"view_beside(Path({str(tmp_path)!r})); sys.stdin.readline(); print('done')"
    )
    words, pipe = [sys.executable, "-c", code], subprocess.PIPE
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=pipe, text=True) as shown:
        assert "does not contain a finished run" in shown.stderr.readline()
        assert shown.communicate("\n", timeout=60) == ("done\n", "")
        assert shown.returncode == 0


def test_a_viewer_beside_a_run_ends_with_it(small_demo):
    pytest.importorskip("viser", reason="the extra view is not installed")
    with subprocess.Popen(
        [*VIEW, small_demo, "--port", "0", "--beside", "1"], stderr=subprocess.PIPE
    ) as viewer:
        assert viewer.wait(60) == 0  # whose parent is another process than 1


@pytest.fixture
def page(small_demo):
    """The process that shows a run, and its address."""
    pytest.importorskip("viser", reason="the extra view is not installed")
    words, pipe = [*VIEW, str(small_demo), "--port", "0"], subprocess.PIPE
    with subprocess.Popen(words, stderr=pipe, text=True) as viewer:
        try:
            yield viewer, viewer.stderr.readline().split()[0]
        finally:
            viewer.kill()


def test_the_address_is_printed_however_quiet_and_in_json(small_demo):
    pytest.importorskip("viser", reason="the extra view is not installed")
    words = [*VIEW, str(small_demo), "--port", "0", "--quiet", "--json"]
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True) as viewer:
        url = viewer.stderr.readline().split()[0]
        viewer.send_signal(signal.SIGINT)
        out, err = viewer.communicate(timeout=60)
    assert (json.loads(out), err) == ({"url": url}, "")


def test_ctrl_c_ends_the_page_with_success_and_no_more_words(page):
    viewer, url = page
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{43}", url)
    assert asked(url).status == 200
    viewer.send_signal(signal.SIGINT)
    assert viewer.communicate(timeout=60)[1] == ""
    assert viewer.returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(chromium.PROGRAM is None, reason="Chromium is not installed")
def test_chromium_shows_it_without_an_error_or_a_request_to_anybody_else(
    page, small_demo, tmp_path
):
    viewer, url = page
    cloud_bytes = 15 * len(read_ply(small_demo / "map/cloud.ply"))
    with chromium.opened(tmp_path) as shown:
        shown.open(url)
        shown.wait(120.0, cloud_bytes)
        shown.wait(5.0)
        assert shown.received >= cloud_bytes
        assert shown.errors == []
        outside = [one for one in shown.urls if one not in (url, url.replace("http", "ws", 1))]
        assert [one for one in outside if not one.startswith(("blob:", "data:", "about:"))] == []
        assert shown.run("location.href") == url
    viewer.send_signal(signal.SIGINT)
    assert viewer.wait(60) == 0

"""`recon live` maps as `recon map` does where it keeps up; `recon localize` says where it is."""

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.commands.localize import run_live
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.errors import CalibrationError, MappingError, SettingsError, SourceError
from recon.core.progress import Counted, Silent, showing
from recon.core.values import RectifiedCamera
from recon.io.cameras.calibration import read_calibration
from recon.io.models.rasters import read_grid
from recon.io.trajectory import read_tum
from recon.map.drive.drive import MapBehind
from recon.map.drive.mapper import FrameResult
from recon.map.map import Map
from recon.rig.capture import (
    CameraSource,
    CaptureSettings,
    RecordingSettings,
    is_camera,
    open_camera_source,
)
from recon.run.finished import GRID
from recon.sources import live
from recon.sources.live import LiveSource
from recon.sources.settings import SourceSettings
from recon.street.settings import StreetScene
from tests.commands.test_cameras import FakeCamera
from tests.flow.runs import all_files, keep_turned_rig, summary_of
from tests.hostile.refusals import assert_refused, run
from tests.look import faults
from tests.scenery.film import RIG, film
from tests.scenery.kitti import write_kitti
from tests.scenery.patience import be_patient
from tests.sources import drives

SMALL = RectifiedCamera(10.0, 5.5, 3.5, 5.5, 0.5, 12, 8)
"""Of the images of `FakeCamera`."""
Play = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def street(street_film):
    return street_film.taken(slice(0, 8))


@pytest.fixture(scope="module")
def mapped(street, tmp_path_factory):
    out = tmp_path_factory.mktemp("mapped") / "run"
    run_map(street, load_config(), MapOptions(out=out, mesh=False, audit=False))
    return out


@pytest.fixture
def patient(monkeypatch):
    be_patient(monkeypatch)


class Watch(Silent):
    steps: list[FrameResult]


@pytest.fixture
def watch():
    watch = Watch()
    watch.steps = []
    watch.on_step = lambda s: None if isinstance(s, Counted) else watch.steps.append(s)
    return watch


@pytest.fixture
def play(tmp_path, watch):
    def play_drive(source, config=None, rate=10.0, **options):
        into = MapOptions("live", tmp_path / "live", mesh=False)
        with showing(watch):
            return run_live(source, config or load_config(), into, rate=rate, **options).to_json()

    return play_drive


def test_a_drive_that_is_kept_up_with_gives_the_same_map(
    street, mapped, patient, play, watch, tmp_path
):
    """But for the poses, which rest on features alone."""
    summary, usual = play(street), summary_of(mapped)
    assert summary["points"] == pytest.approx(usual["points"], rel=0.05)
    assert summary["odometry"] == "visual"
    found_m = read_tum(tmp_path / "live" / "trajectory_tum.txt").positions_m
    off_m = np.linalg.norm(found_m - street.trajectory.positions_m, axis=1)
    # Steps are independent, and none of so few is off by more than four of its sigmas.
    sigma_m = np.sqrt(np.cumsum([step.health.sigma_m**2 for step in watch.steps[1:]]))
    assert (off_m[1:] < 4 * sigma_m).all()
    assert np.median(off_m) < 0.1
    assert summary["live"]["frames_arrived"] == 8
    assert summary["live"]["frames_dropped"] == summary["live"]["frames_not_matched"] == 0
    latency_ms = summary["live"]["latency_ms"]
    assert 0 < latency_ms["p50"] <= latency_ms["p95"] <= latency_ms["max"]
    assert summary_of(tmp_path / "live") == summary


def test_a_machine_that_is_much_too_slow_has_poses_and_is_told_why_there_is_no_map(
    street, play, watch, monkeypatch, tmp_path
):
    def of_the_first(self: MapBehind, late: Any, last: object) -> None:
        self._map_frame(*late, late[0].index == 0)

    monkeypatch.setattr(live, "_WAITING", 1000)
    monkeypatch.setattr(MapBehind, "_map", of_the_first)
    monkeypatch.setattr(LiveSource, "warnings", lambda self: ["7 frames came too fast"])
    with pytest.raises(MappingError, match=r"the map is empty.*7 frames came too fast.*--rate"):
        play(street)
    found_m = np.stack([step.T_world_camera[:3, 3] for step in watch.steps])
    assert np.linalg.norm(found_m - street.trajectory.positions_m, axis=1).max() < 0.2
    assert all(step.ok for step in watch.steps)
    assert not (tmp_path / "live" / "summary.json").exists()


def test_a_drive_ends_when_it_is_told_to_and_its_map_is_completed(
    street, patient, play, watch, tmp_path
):
    with pytest.raises(SourceError, match="stopped before its first frame"):
        play(street, stopped=lambda: True)
    assert not (tmp_path / "live").exists()
    assert play(street, stopped=lambda: len(watch.steps) >= 5)["frames"] == 5
    assert (tmp_path / "live" / "map" / "cloud.ply").is_file()
    watch.steps.clear()
    # A gap at the beginning, of an hour, is not waited for.
    late = street.taken(slice(0, 2))
    late.frames = lambda start=0: (replace(p, timestamp_s=3600.0 * p.index) for p in late.pairs)
    assert play(late, rate=1.0, stopped=lambda: bool(watch.steps))["frames"] == 1


def test_a_drive_is_found_in_a_map_while_it_arrives(street, mapped, patient, play, tmp_path):
    summary = play(street, map_path=mapped)
    assert summary["frames_tracking"] + summary["frames_coasting"] >= 7
    assert summary["live"]["frames_arrived"] == 8
    assert (tmp_path / "live" / "states.csv").is_file()


@pytest.mark.slow
def test_a_drive_without_a_map_says_what_is_wrong_with_its_rig_and_keeps_it(
    patient, play, tmp_path
):
    size = {"width_px": 400, "height_px": 136, "focal_px": 225.0, "smooth_edges": False}
    turned = faults.turned(film(StreetScene(frames=96, seed=3, **size)), yaw_deg=0.25)
    summary, out = play(turned), tmp_path / "live"
    assert not summary["rig"]["refined"]
    assert summary["rig"]["yaw_deg"] == pytest.approx(-0.25, abs=0.1)
    said = "\n".join(summary["warnings"])
    assert "used is the calibration as it is" in said
    assert "rig.yaml is the rig that this drive showed" in said
    with Map.open(out) as map_:
        kept = map_.known_rig(turned.calibration).calibration
    found = read_calibration(out / "rig.yaml")
    np.testing.assert_allclose(found.T_right_left, kept.T_right_left, atol=1e-9)


def test_what_cannot_be_played_is_refused(street, play):
    with pytest.raises(SettingsError, match="the points that kiss-icp needs"):
        play(street, load_config(None, ["odometry.method=kiss"]))
    for rate in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(SettingsError, match="not a rate"):
            play(street, rate=rate)


@pytest.fixture(scope="module")
def videos(street_film, tmp_path_factory):
    folder = tmp_path_factory.mktemp("videos")
    grey = street_film.taken(slice(None), lambda image: image[..., 1].copy())
    return drives.write_two_videos(grey.pairs, grey.calibration, folder)


def test_cameras_are_mapped(videos, street_film, patient, tmp_path):
    out, names = tmp_path / "run", [videos / name for name in ("left.avi", "right.avi")]
    done = run("live", *names, "--calib", videos / "calib.txt", "--rate", "5", "--out", out)
    assert done.code == 0, done.err
    path = read_tum(out / "trajectory_tum.txt")
    # The first pair gives the image size, three more warm up.
    frames = summary_of(out)["frames"]
    assert frames == len(path) == len(street_film) - 4
    truth = street_film.trajectory.positions_m
    length_m = np.linalg.norm(np.diff(truth[4:], axis=0), axis=1).sum()
    assert path.path_length_m == pytest.approx(length_m, rel=0.05)
    assert (out / "map" / "cloud.ply").stat().st_size > 10_000


@pytest.mark.parametrize(("words", "said"), [
    ("{}/left.avi {}/right.avi", "--calib"),
    ("{}/left.avi none.avi --calib {}/calib.txt", "camera cannot be opened"),
    ("/dev/video99 --calib {}/calib.txt", "camera cannot be opened"),
    ("99 --calib {}/calib.txt", "camera cannot be opened"),
    ("nothing", "folder does not exist"),
])  # fmt: skip
def test_what_is_no_camera_is_refused(videos, tmp_path, words, said):
    names = words.replace("{}", str(videos)).split()
    assert_refused(run("live", *names, "--out", tmp_path / "run", "--quiet"), said)
    assert not (tmp_path / "run").exists()


def test_pairs_of_cameras_are_numbered_and_keep_the_time_they_were_taken():
    stamps_s = [5.0, 5.1, 5.2, 5.3, 5.4]
    cameras = (FakeCamera("0", stamps_s), FakeCamera("2", [t + 0.004 for t in stamps_s[:4]]))
    source = CameraSource(cameras, RecordingSettings(frames=2), SMALL)
    assert (source.name, len(source), source.live) == ("0 and 2", 2, True)
    assert [(pair.index, pair.timestamp_s) for pair in source] == [(0, 5.0), (1, 5.1)]
    assert [(pair.index, pair.timestamp_s) for pair in source] == [(0, 5.2), (1, 5.3)]
    with pytest.raises(SourceError, match="camera gives no more frames"):
        list(LiveSource(source, rate=None))


def test_cameras_are_numbers_devices_and_files_of_one_size(videos, tmp_path):
    assert [is_camera(name) for name in ("0", "rtsp://host/left", "/dev/video9")] == [True] * 3
    assert [is_camera(name) for name in (str(tmp_path), "rides/today")] == [False] * 2
    devices = [str(videos / "left.avi"), str(videos / "right.avi")]
    numbers = SourceSettings(focal_px=300, baseline_m=0.2)
    with open_camera_source(devices, CaptureSettings(), numbers) as source:
        assert (source.calibration.focal_px, source.calibration.baseline_m) == (300, 0.2)
    wrong = SourceSettings(calibration=str(tmp_path / "calib.txt"))
    (tmp_path / "calib.txt").write_text(
        "cam0=[10 0 9; 0 10 9; 0 0 1]\ncam1=[10 0 9; 0 10 9; 0 0 1]\nbaseline=500\n"
        "doffs=0\nwidth=18\nheight=18\n"
    )
    with pytest.raises(CalibrationError, match="size"):
        open_camera_source(devices, CaptureSettings(), wrong).__enter__()


@pytest.fixture(scope="module")
def drive(street_film, tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    write_kitti(street_film, folder)
    (folder / "empty").mkdir()
    return folder


@pytest.fixture(scope="module")
def even_map(drive, tmp_path_factory):
    """Of the even frames, at known poses; with a damaged copy of the map."""
    out = tmp_path_factory.mktemp("map") / "run"
    words = ("--stride", "2", "--poses", drive / "poses.txt", "--no-mesh", "--quiet")
    done = run("map", drive, *words, "--out", out)
    assert done.code == 0, done.err
    content = bytearray((out / "map" / "map.recon").read_bytes())
    for place in range(len(content) // 3, len(content), 4096):
        content[place] ^= 255
    (out.parent / "damaged.recon").write_bytes(content)
    return out


def test_files_are_left_and_the_map_as_it_was(drive, even_map, tmp_path):
    before, out = all_files(even_map), tmp_path / "found"
    done = run("localize", drive, "--map", even_map, "--start", "1", "--stride", "2", "-o", out)
    assert done.code == 0, done.err
    assert all_files(even_map) == before
    summary = summary_of(out)
    states = list(csv.DictReader((out / "states.csv").open()))
    tracked = [row for row in states if row["state"] == "tracking"]
    assert summary["frames"] == len(states) == 6
    assert summary["frames_tracking"] == len(tracked) >= 5
    assert summary["first_fix_frame"] == int(tracked[0]["frame"]) <= 1
    path = read_tum(out / "trajectory_tum.txt")
    assert len(path) == len(read_tum(out / "trajectory_map_base_tum.txt")) == len(tracked)
    place = [float(tracked[0][axis]) for axis in ("x_m", "y_m", "z_m")]
    assert place == pytest.approx(path.positions_m[0], abs=1e-6)
    assert 0 < float(tracked[0]["sigma_x_m"]) < 0.1  # of a pose that is right to centimetres
    assert float(tracked[0]["cov_x_x"]) == pytest.approx(float(tracked[0]["sigma_x_m"]) ** 2)
    assert "In the map" in (out / "report.html").read_text()


def test_the_map_file_alone_will_do_and_its_rig_is_begun_with(drive, even_map, tmp_path):
    file, out = shutil.copy(even_map / "map" / "map.recon", tmp_path), tmp_path / "out"
    keep_turned_rig(file)
    words = ("--map", file, "--json", "--end", "4", "--out", out)
    assert run("localize", drive, *words).code == 0
    summary = summary_of(out)
    assert summary["frames_tracking"] >= 3
    assert summary["rig"]["begun_with"].startswith("session 0 (")
    assert (out / "rig.yaml").is_file()


def test_what_a_robot_is_told_is_a_bag_in_the_run(drive, even_map, tmp_path):
    highlevel, out = pytest.importorskip("rosbags.highlevel"), tmp_path / "found"
    words = ("--map", even_map, "--start", "1", "--stride", "2", "--to", "mcap", "--out", out)
    done = run("localize", drive, *words)
    assert done.code == 0, done.err
    with highlevel.AnyReader([out / "bag"]) as bag:
        seen = [(one.topic, bag.deserialize(raw, one.msgtype)) for one, _, raw in bag.messages()]
    path = read_tum(out / "trajectory_map_base_tum.txt")
    poses = [message.pose.pose.position for topic, message in seen if topic == "/pose"]
    found_m = np.array([(at.x, at.y, at.z) for at in poses])
    np.testing.assert_allclose(found_m, path.positions_m, atol=1e-6)
    (grid,), kept = [m for topic, m in seen if topic == "/map"], read_grid(even_map / GRID)
    assert grid.data.reshape(kept.cells.shape).tolist() == kept.cells.tolist()
    assert {"/tf", "/tf_static", "/odometry", "/path", "/diagnostics", "/costmap", "/cloud"} <= {
        topic for topic, _ in seen
    }
    layout = json.loads((out / "bag/foxglove.json").read_text())
    shown = layout["configById"]["3D!map"]
    assert shown["followTf"] == "base_link"
    assert {"/map", "/cloud", "/odometry"} <= set(shown["topics"])
    assert "bag/bag.mcap" in json.loads((out / "run.json").read_text())["files"]
    assert_refused(run("localize", drive, *words[:-4], "--to", "grid"), "recon export makes it")


def test_a_drive_elsewhere_gets_a_warning_and_no_pose(even_map, tmp_path):
    write_kitti(film(StreetScene(frames=3, seed=7, **RIG)), tmp_path / "other")
    done = run("localize", tmp_path / "other", "--map", even_map, "--out", tmp_path / "found")
    assert done.code == 0
    assert "not found in the map" in done.err
    summary = summary_of(tmp_path / "found")
    assert (summary["frames_tracking"], summary["first_fix_frame"]) == (0, None)
    assert (tmp_path / "found" / "trajectory_tum.txt").read_text() == ""


def test_a_live_drive_that_was_killed_says_where_its_map_is(even_map, tmp_path):
    """It cannot be gone on with, since what arrives in its own time does not arrive again."""
    state = tmp_path / "run" / ".partial" / ".state"
    state.mkdir(parents=True)
    with Map.create(state / "map.recon") as map_, Map.open(even_map) as other:
        map_.begin(replace(other.first.info, start={}))
        map_.commit()
    refused = run("map", "--resume", tmp_path / "run")
    assert_refused(refused, "a drive that arrived live cannot be resumed")
    assert "map.recon" in refused.err


def test_a_map_that_is_none_is_said_before_cameras_are_waited_for(tmp_path, monkeypatch):
    pytest.importorskip("cyclonedds")
    monkeypatch.setattr("recon.sources.ros2.Network", lambda: pytest.fail("somebody is waited for"))
    done = run("live", "ros2:", "--map", tmp_path / "none", "--out", tmp_path / "out")
    assert_refused(done, "none")


@pytest.mark.parametrize(("words", "said"), [
    ("ros2:/left,/right --map {map}", "recon live takes topics"),
    ("{drive} --map missing", "missing"),
    ("{drive} --map {drive}", "map.recon"),
    ("{drive} --map {drive}/calib.txt", "not a map of recon"),
    ("{drive} --map {map} --start 1,2", "--start"),
    ("{drive} --map {map} --start here", "--start"),
    ("{drive} --map {map} --start nan,0,0", "--start"),
    ("{drive} --map {map} --start 900,0,0", "near the start pose"),
    ("{drive} --map {map} --out {map}", "would replace"),
    ("{drive} --map {map} --start 500", "500"),
    ("{drive}/empty --map {map}", "empty"),
    ("{drive} --map {map}/../damaged.recon --end 4", "damaged.recon"),
])  # fmt: skip
def test_what_cannot_be_is_refused_in_one_line(
    drive, even_map, tmp_path, monkeypatch,
    words, said,
):  # fmt: skip
    monkeypatch.chdir(tmp_path)
    done = run("localize", *words.format(drive=drive, map=even_map).split(), "--quiet")
    assert_refused(done, said)
    assert list(tmp_path.iterdir()) == []

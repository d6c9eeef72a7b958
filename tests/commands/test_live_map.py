"""`recon.LiveMap`: pairs in, pose and map out, for a program that has its own loop."""

import runpy
import sys
import threading
from contextlib import suppress
from datetime import timedelta
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar
from unittest.mock import MagicMock

import numpy as np
import pytest

import recon
from recon.commands import live_map
from recon.core.errors import CalibrationError, MappingError, ReconError, ShapeError, SourceError
from recon.core.geometry.se3 import make_transform
from recon.io.cameras.calibration import write_recon_calibration
from recon.sources.live import PushedSource
from recon.street.settings import StreetScene
from tests.scenery.film import RIG, Film, film
from tests.scenery.patience import LONG_S

SIZE = (120, 320)
IMAGE = np.zeros(SIZE, np.uint8)


@pytest.fixture(scope="module")
def street():
    return film(StreetScene(frames=8, seed=1, **RIG))


@pytest.fixture
def slow(monkeypatch):
    """Work that takes pairs when it is told to."""
    work = SimpleNamespace(go=threading.Semaphore(0), taken=[], error=None, begun=threading.Event())

    def run(source: PushedSource, *_: object, **__: object) -> None:
        for pair in source.frames():
            work.begun.set()
            work.taken.append(pair.index)
            if work.error is not None:
                raise work.error
            assert work.go.acquire(timeout=LONG_S)

    monkeypatch.setattr(live_map, "run_live", run)
    return work


def test_every_pair_that_is_waited_for_is_in_the_map(street, blank_figures, tmp_path):
    out = tmp_path / "run"
    with recon.LiveMap(street.calibration, out=out, wait=True) as live:
        assert live.pose is None
        for pair in street.pairs:
            live.push(pair.left, pair.right, 5.0 + 0.1 * pair.index)
        assert live.dropped == 0
    assert live.summary.frames == len(street)
    found, truth = live.pose, street.trajectory.T_world_camera
    assert found.trusted
    assert found.time_s == pytest.approx(5.7)
    moved = np.linalg.norm(truth[-1][:3, 3] - truth[0][:3, 3])
    assert np.linalg.norm(found.T_map_camera[:3, 3]) == pytest.approx(moved, abs=0.2)
    assert 0 < found.sigma_m < 0.5
    assert "tracking" in repr(found)
    grid, kept = live.grid(), recon.read_grid(out / "map" / "grid.yaml")
    np.testing.assert_array_equal(grid.cells, kept.cells)
    assert live.costmap().cells.shape == grid.cells.shape
    assert len(live.cloud()) > 1000


@pytest.mark.slow
def test_a_map_is_searched_and_nothing_is_kept_unless_that_is_asked_for(
    street, blank_figures, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with recon.LiveMap(street.calibration, out="run", wait=True) as live:
        for pair in street.pairs:
            live.push(pair.left, pair.right, 0.1 * pair.index)
    with recon.LiveMap(street.calibration, map_path="run", wait=True) as found:
        for pair in street.pairs[3:]:
            found.push(pair.left, pair.right, 0.1 * pair.index)
    assert np.linalg.norm(found.pose.T_map_camera[:3, 3] - live.pose.T_map_camera[:3, 3]) < 0.3
    np.testing.assert_array_equal(found.grid().cells, live.grid().cells)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_push_does_not_wait_and_the_newest_pair_counts(slow, street):
    with recon.LiveMap(street.calibration) as live:
        live.push(IMAGE, IMAGE, 0.0)
        assert slow.begun.wait(LONG_S)
        for n in range(1, 6):
            live.push(IMAGE, IMAGE, float(n))
        assert live.dropped == 4
        slow.go.release(2)
    assert slow.taken == [0, 5]


def test_images_may_be_changed_after_they_were_pushed(slow, street):
    left = IMAGE.copy()
    with recon.LiveMap(street.calibration) as live:
        live.push(left, IMAGE, 0.0)
        left[:] = 9
        assert not live._source._waiting or live._source._waiting[0][0].left.max() == 0
        slow.go.release()


@pytest.mark.parametrize(("left", "right", "time_s", "error", "said"), [
    (IMAGE, IMAGE, float("nan"), SourceError, "not the time of a later pair"),
    (IMAGE, IMAGE, float("inf"), SourceError, "not the time of a later pair"),
    (IMAGE, IMAGE, 1.0, SourceError, "seconds after 1"),
    (IMAGE, IMAGE, 0.5, SourceError, "seconds after 1"),
    (IMAGE, IMAGE, None, SourceError, "not the time of a later pair"),
    (IMAGE, IMAGE, "2", SourceError, "not the time of a later pair"),
    (IMAGE, IMAGE[:60], 2.0, ReconError, "size"),
    (IMAGE[:60], IMAGE[:60], 2.0, CalibrationError, "320x120"),
    (IMAGE.astype(np.float32), IMAGE, 2.0, ShapeError, "uint8"),
    (IMAGE.astype(np.uint16), IMAGE.astype(np.uint16), 2.0, ShapeError, "uint8"),
    (np.zeros((120, 320, 4), np.uint8), IMAGE, 2.0, ShapeError, "shape"),
    (None, IMAGE, 2.0, ShapeError, "not two images"),
    ([[1, 2], [3]], IMAGE, 2.0, ShapeError, "not two images"),
])  # fmt: skip
def test_what_is_no_pair_is_refused_and_the_drive_goes_on(
    slow, street, left, right, time_s, error, said
):
    with recon.LiveMap(street.calibration) as live:
        live.push(IMAGE, IMAGE, 1.0)
        with pytest.raises(error, match=said):
            live.push(left, right, time_s)
        live.push(IMAGE, IMAGE, 2.0)
        slow.go.release(9)


def test_threads_that_push_their_first_pairs_at_once_begin_one_drive(slow, street, monkeypatch):
    made, both = [], threading.Barrier(2)

    def source(*args: object, **kwargs: object) -> PushedSource:
        with suppress(threading.BrokenBarrierError):  # nobody comes, if only one is made
            both.wait(0.2)
        made.append(PushedSource(*args, **kwargs))
        return made[-1]

    monkeypatch.setattr(live_map, "PushedSource", source)
    slow.go.release(9)
    with recon.LiveMap(street.calibration) as live:
        refused: list[BaseException] = []
        monkeypatch.setattr(threading, "excepthook", lambda told: refused.append(told.exc_value))
        pushes = [threading.Thread(target=live.push, args=(IMAGE, IMAGE, 0.0)) for _ in range(2)]
        for push in pushes:
            push.start()
        for push in pushes:
            push.join(LONG_S)
    assert len(made) == 1
    assert ["not the time of a later pair" in str(error) for error in refused] == [True]


def test_nothing_comes_of_nothing(slow, street, tmp_path):
    with pytest.raises(SourceError, match="no pair was pushed"), recon.LiveMap(street.calibration):
        pass
    with recon.LiveMap(street.calibration) as live:
        with pytest.raises(MappingError, match="nothing in the map yet"):
            live.grid()
        live.push(IMAGE, IMAGE, 0.0)
        slow.go.release(9)
    with pytest.raises(SourceError, match="the drive is over"):
        live.push(IMAGE, IMAGE, 1.0)
    with (
        pytest.raises(ReconError, match=r"none\.yaml"),
        recon.LiveMap(tmp_path / "none.yaml") as live,
    ):
        live.push(IMAGE, IMAGE, 0.0)


def test_a_calibration_file_is_that_of_the_images(slow, street, tmp_path):
    write_recon_calibration(tmp_path / "rig.yaml", street.calibration)
    with recon.LiveMap(tmp_path / "rig.yaml") as live:
        live.push(IMAGE, IMAGE, 0.0)
        slow.go.release(9)
    assert live._source.calibration == street.calibration


@pytest.mark.parametrize("wait", [False, True])
def test_an_error_of_the_work_is_raised_where_the_program_is(slow, street, wait):
    slow.error = MappingError("the map is empty", hint="move the camera")

    live = recon.LiveMap(street.calibration, wait=wait)

    def use() -> None:
        with live:
            for n in range(1000):
                live.push(IMAGE, IMAGE, float(n))
                live._thread.join(LONG_S)

    with pytest.raises(MappingError, match="the map is empty; move the camera"):
        use()
    with pytest.raises(MappingError, match="the map is empty"):
        _ = live.pose


def test_an_error_of_the_program_ends_the_drive_at_once(slow, street):
    live = recon.LiveMap(street.calibration)

    def use() -> None:
        with live:
            live.push(IMAGE, IMAGE, 0.0)
            assert slow.begun.wait(LONG_S)
            live.push(IMAGE, IMAGE, 1.0)
            slow.go.release(9)
            raise KeyError

    with pytest.raises(KeyError):
        use()
    assert not live._thread.is_alive()


def test_progress_is_shown_where_the_program_shows_it(slow, street):
    class Shown(recon.Progress):
        stages: ClassVar[list[str]] = []

        def on_stage(self, name: str) -> None:
            self.stages.append(name)

    def run(source: PushedSource, *_: object, **__: object) -> None:
        from recon.core.progress import stage

        stage("look")
        list(source.frames())

    with pytest.MonkeyPatch.context() as patch, recon.showing(Shown()):
        patch.setattr(live_map, "run_live", run)
        with recon.LiveMap(street.calibration) as live:
            live.push(IMAGE, IMAGE, 0.0)
    assert Shown.stages == ["look"]


def stand_in(street: Film) -> MagicMock:
    """Answer as either package does of a device that sees the street, and then Ctrl-C."""
    camera, package = street.calibration, MagicMock()
    pairs = [{"left": p.left[..., 1], "right": p.right[..., 1]} for p in street.pairs]
    T_right_left = make_transform(np.eye(3), np.array([-camera.baseline_m, 0.0, 0.0]))
    # Of depthai.
    device = package.Pipeline.return_value.__enter__.return_value
    kept = device.getDefaultDevice.return_value.readCalibration.return_value
    kept.getCameraIntrinsics.return_value = camera.matrix.tolist()
    kept.getDistortionCoefficients.return_value = [0.0] * 14
    kept.getCameraExtrinsics.return_value = T_right_left.tolist()
    queue = device.create.return_value.out.createOutputQueue.return_value
    queue.get.side_effect = [
        {side: MagicMock(**{"getTimestamp.return_value": timedelta(seconds=0.1 * n),
                            "getCvFrame.return_value": pair[side]}) for side in pair}
        for n, pair in enumerate(pairs)
    ] + [KeyboardInterrupt]  # fmt: skip
    # Of pyrealsense2.
    stream = package.pipeline.return_value.start.return_value.get_stream.return_value
    seen = stream.as_video_stream_profile.return_value
    seen.get_extrinsics_to.return_value.translation = T_right_left[:3, 3].tolist()
    lens = {"fx": camera.focal_px, "ppx": camera.cx_px, "ppy": camera.cy_px}
    seen.get_intrinsics.return_value = SimpleNamespace(**lens)
    frames = [MagicMock(**{"get_timestamp.return_value": 100.0 * n}) for n in range(len(pairs))]
    for frame, pair in zip(frames, pairs, strict=True):
        frame.get_infrared_frame.side_effect = [
            MagicMock(**{"get_data.return_value": image}) for image in pair.values()
        ]
    package.pipeline.return_value.wait_for_frames.side_effect = [*frames, KeyboardInterrupt]
    return package


@pytest.mark.slow
@pytest.mark.parametrize(("example", "package", "size"), [
    ("05_depthai", "depthai", ("SIZE",)),
    ("06_realsense", "pyrealsense2", ("WIDTH_PX", "HEIGHT_PX"))
])  # fmt: skip
def test_an_example_maps_what_its_camera_sees(
    street, example, package, size, blank_figures, tmp_path, monkeypatch, capsys
):
    monkeypatch.setitem(sys.modules, package, stand_in(street))
    monkeypatch.setattr(recon, "LiveMap", partial(recon.LiveMap, wait=True), raising=False)
    path = Path(__file__).parents[2] / "examples" / f"{example}.py"
    main = runpy.run_path(str(path))["main"]
    pixels = (SIZE[1], SIZE[0])
    sizes = [pixels] if len(size) == 1 else pixels
    main.__globals__.update(zip(size, sizes, strict=True))
    main(tmp_path / "run")
    assert "tracking" in capsys.readouterr().out
    assert (tmp_path / "run" / "map" / "grid.yaml").is_file()

"""The same drive in every layout gives the same pairs, and the same trajectory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.values import RectifiedCamera, StereoPair
from recon.core.values.arrays import Float64
from recon.map.drive.sequence import Workspace, map_sequence
from recon.sources.registry import open_source, recognise_source
from tests.sources import drives
from tests.sources.drives import FRAMES

pytest.importorskip("rosbags", reason="extra ros")
from tests.sources.bags import bag

LAYOUTS: dict[str, tuple[str, drives.Writer]] = {
    "kitti": ("kitti", drives.write_kitti),
    "kitti raw": ("kitti-raw", drives.write_kitti_raw),
    "euroc": ("euroc", drives.write_euroc),
    "tum": ("tum", drives.write_tum),
    "folders": ("folders", drives.write_folders),
    "stamped folders": ("folders", drives.write_stamped),
    "side by side": ("video", drives.write_side_by_side),
    "two videos": ("video", drives.write_two_videos),
    "ros 1": ("bag", bag(kind="ros1")),
    "ros 2": ("bag", bag(kind="ros2")),
    "ros 2 compressed": ("bag", bag(kind="ros2", compressed=True)),
    "mcap": ("bag", bag(kind="mcap")),
}


@pytest.fixture(scope="module")
def drive() -> tuple[list[StereoPair], RectifiedCamera]:
    return drives.rendered(FRAMES, width_px=320, height_px=128, focal_px=180.0, smooth_edges=False)


@pytest.fixture(scope="module")
def written(
    drive: tuple[list[StereoPair], RectifiedCamera], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("drives")
    return {name: write(*drive, folder / name) for name, (_, write) in LAYOUTS.items()}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_each_layout_is_recognised_and_gives_every_pixel_and_time(
    written: dict[str, Path], drive: tuple[list[StereoPair], RectifiedCamera], layout: str
) -> None:
    pairs, camera = drive
    assert recognise_source(written[layout]) == LAYOUTS[layout][0]
    source = open_source(written[layout])
    assert len(source) == len(pairs)
    assert isinstance(source.calibration, RectifiedCamera)
    assert source.calibration.baseline_m == pytest.approx(camera.baseline_m, rel=1e-12)
    times = np.array([pair.timestamp_s for pair in source])
    # Stamps of today have 0.2 µs in a double.
    np.testing.assert_allclose(times - times[0], [p.timestamp_s for p in pairs], atol=1e-6)
    assert "\n" not in source.description
    assert all(path.is_file() for path in source.files)


def assert_equal_image(ours: np.ndarray, truth: np.ndarray) -> None:
    """A video has three channels, of a grey image three equal ones."""
    expected = truth if ours.ndim == 2 else np.repeat(truth[:, :, None], 3, axis=2)
    np.testing.assert_array_equal(ours, expected)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("start", [0, 7, FRAMES - 1, FRAMES])
def test_a_drive_can_be_entered_at_any_pair(
    written: dict[str, Path], drive: tuple[list[StereoPair], RectifiedCamera],
    layout: str, start: int,
) -> None:  # fmt: skip
    pairs, _ = drive
    read = list(open_source(written[layout]).frames(start))
    assert [pair.index for pair in read] == list(range(start, FRAMES))
    for ours, truth in zip(read, pairs[start:], strict=True):
        assert_equal_image(ours.left, truth.left)
        assert_equal_image(ours.right, truth.right)


def trajectory(path: Path) -> Float64:
    config = load_config(overrides=["matching.matcher=opencv-bm", "fusion.voxel_m=0.5"])
    work = Workspace(threads=1)
    return map_sequence(open_source(path), config, workspace=work).trajectory.T_world_camera


@pytest.mark.slow
def test_every_layout_gives_the_same_trajectory(written: dict[str, Path]) -> None:
    expected = trajectory(written["kitti"])
    travelled_m = np.linalg.norm(expected[-1, :3, 3])
    assert travelled_m > 8  # eleven frames a metre apart: it does follow the drive
    for layout, path in written.items():
        # Stamps of today have 0.2 µs in a double, and a motion goes on by its times: over eleven
        # metres that is a tenth of a millimetre, and no pixel.
        apart = np.abs(trajectory(path) - expected).max()
        assert apart < 1e-4, layout


@pytest.mark.slow
def test_a_lossy_video_gives_the_same_trajectory_up_to_its_codec(
    written: dict[str, Path], drive: tuple[list[StereoPair], RectifiedCamera], tmp_path: Path
) -> None:
    expected = trajectory(written["kitti"])
    lossy = trajectory(drives.write_lossy_videos(*drive, tmp_path))
    apart_m = np.linalg.norm(lossy[:, :3, 3] - expected[:, :3, 3], axis=1)
    # MPEG-4 at OpenCV's default rate blurs what corners are made of.
    assert 0 < apart_m.max() < 0.05 * np.linalg.norm(expected[-1, :3, 3])

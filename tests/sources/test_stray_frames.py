"""Images without a partner are left out, counted and told; times and truth stay theirs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import SourceError
from recon.core.values import RectifiedCamera, StereoPair
from recon.io.images.image import write_image
from recon.io.trajectory import FRAMES, CapturedFrame
from recon.sources.registry import open_source
from tests.sources import drives

CAMERA = RectifiedCamera(60.0, 31.5, 15.5, 31.5, 0.5, 64, 32)
FRAMES_WRITTEN = 8


@pytest.fixture(scope="module")
def pairs() -> list[StereoPair]:
    """The grey value of both images is the number of the frame; frames are 0.1 s apart."""
    images = (np.full((32, 64), index, np.uint8) for index in range(FRAMES_WRITTEN))
    return [StereoPair(image, image, 0.1 * k, k) for k, image in enumerate(images)]


def write_kitti(pairs: list[StereoPair], camera: RectifiedCamera, folder: Path) -> Path:
    drives.write_kitti(pairs, camera, folder)
    rows = [f"1 0 0 0 0 1 0 0 0 0 1 {pair.index}\n" for pair in pairs]
    (folder / "poses.txt").write_text("".join(rows))
    return folder


def write_folders(pairs: list[StereoPair], camera: RectifiedCamera, folder: Path) -> Path:
    drives.write_folders(pairs, camera, folder)
    (folder / "times.txt").write_text("".join(f"{pair.timestamp_s}\n" for pair in pairs))
    return folder


def write_one_folder(pairs: list[StereoPair], camera: RectifiedCamera, folder: Path) -> Path:
    for pair in pairs:
        write_image(folder / f"left{pair.index:02d}.png", pair.left)
        write_image(folder / f"right{pair.index:02d}.png", pair.right)
    write_image(folder / "preview.png", pairs[0].left)
    drives.write_calib(folder, camera)
    return folder


def write_capture(pairs: list[StereoPair], camera: RectifiedCamera, folder: Path) -> Path:
    drives.write_folders(pairs, camera, folder)
    lines = [
        CapturedFrame(f"left/left{k}.png", f"right/right{k}.png", 0.1 * k, 0.1 * k).line()
        for k in range(len(pairs))
    ]
    (folder / FRAMES).write_text("".join(lines))
    return folder


def write_stamped(pairs: list[StereoPair], camera: RectifiedCamera, folder: Path) -> Path:
    for pair in pairs:
        for side, image in (("cam0", pair.left), ("cam1", pair.right)):
            stamp_us = round((drives.EPOCH_S + pair.timestamp_s) * 1e6)
            write_image(folder / side / f"{stamp_us}.png", image)
    drives.write_calib(folder, camera)
    return folder


LAYOUTS: dict[str, drives.Writer] = {
    "kitti": write_kitti,
    "kitti-raw": drives.write_kitti_raw,
    "euroc": drives.write_euroc,
    "tum": drives.write_tum,
    "folders": write_folders,
    "one folder": write_one_folder,
    "capture": write_capture,
    "stamped": write_stamped,
}


def images(folder: Path, side: int) -> list[Path]:
    """The images of one camera in order."""
    marks = (("image_0", "image_00", "cam0", "left"), ("image_1", "image_01", "cam1", "right"))
    found = (
        path
        for path in folder.rglob("*.png")
        if path.stem[:4] == marks[side][3][:4] or {*path.relative_to(folder).parts} & {*marks[side]}
    )
    return sorted(found, key=lambda path: (len(path.name), path.name))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_frames_without_a_partner_are_left_out_and_counted(
    pairs: list[StereoPair], tmp_path: Path, layout: str
) -> None:
    folder = LAYOUTS[layout](pairs, CAMERA, tmp_path)
    images(folder, 0)[5].unlink()
    images(folder, 1)[2].unlink()
    source = open_source(folder)
    kept = [0, 1, 3, 4, 6, 7]
    found = list(source)
    assert [(p.left.flat[0], p.right.flat[0]) for p in found] == [(k, k) for k in kept]
    assert source.left_out == 2
    assert "1 left and 1 right without a partner left out" in source.description
    start_s = source.stamps_s[0]
    # Stamps in microseconds.
    np.testing.assert_allclose(source.stamps_s - start_s, 0.1 * np.array(kept), atol=2e-6)
    if source.truth is not None and source.truth.trajectory is not None:
        assert source.truth.trajectory.positions_m[:, 2].tolist() == kept
    assert source.lines(FRAMES_WRITTEN) == kept
    assert source.lines(len(kept)) == list(range(len(kept)))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_most_images_missing_is_an_error(
    pairs: list[StereoPair], tmp_path: Path, layout: str
) -> None:
    if layout == "stamped":
        pytest.skip("without a list, a slower camera looks the same")
    folder = LAYOUTS[layout](pairs, CAMERA, tmp_path)
    for path in images(folder, 1)[1:6]:
        path.unlink()
    with pytest.raises(SourceError, match=r"most images have no partner|numbers of left and right"):
        open_source(folder)


def extra_left(folder: Path) -> None:
    write_image(folder / "image_0" / "000008.png", np.full((32, 64), 8, np.uint8))


def unpaired_row(folder: Path) -> None:
    path = folder / "mav0" / "cam0" / "data.csv"
    path.write_text(path.read_text() + f"{(drives.EPOCH_S + 5) * 10**9},nowhere.png\n")


@pytest.mark.parametrize(
    ("write", "spoil"), [(write_kitti, extra_left), (drives.write_euroc, unpaired_row)]
)
def test_one_stray_entry_stops_nothing(
    pairs: list[StereoPair], tmp_path: Path, write: drives.Writer, spoil: Callable[[Path], None]
) -> None:
    folder = write(pairs, CAMERA, tmp_path)
    spoil(folder)
    source = open_source(folder)
    assert len(list(source)) == FRAMES_WRITTEN
    assert source.left_out == 1

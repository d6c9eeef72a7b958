from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import CalibrationError, FormatError, ReconError, SourceError
from recon.io.images.image import write_image
from recon.sources.one_pair import read_pair, read_pair_input
from recon.sources.registry import open_source, recognise_source
from recon.sources.settings import SourceSettings
from tests.hostile.refusals import assert_refused, run
from tests.sources.drives import CAMERA, write_calib, write_video

KITTI = "P0: 700 0 16 0 0 700 8 0 0 0 1 0\nP1: 700 0 16 -350 0 700 8 0 0 0 1 0\n"
MIDDLEBURY = (
    "cam0=[700 0 16; 0 700 8; 0 0 1]\ncam1=[700 0 18; 0 700 8; 0 0 1]\n"
    "doffs=2\nbaseline=500\nwidth=32\nheight=16\nndisp=20\n"
)


def image(width: int = 32, *, colour: bool = False) -> np.ndarray:
    shape = (16, width, 3) if colour else (16, width)
    return np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)


def make_kitti(folder: Path) -> Path:
    for camera in (0, 1):
        write_image(folder / f"image_{camera}" / "000000.png", image())
    (folder / "calib.txt").write_text(KITTI)
    (folder / "times.txt").write_text("0\n")
    return folder


def make_middlebury(folder: Path) -> Path:
    for name in ("im0.png", "im1.png"):
        write_image(folder / name, image(colour=True))
    (folder / "calib.txt").write_text(MIDDLEBURY)
    return folder


def make_files(folder: Path, right_width: int = 32) -> tuple[Path, Path, Path]:
    write_image(folder / "left.png", image())
    write_image(folder / "right.png", image(right_width))
    (folder / "calib.txt").write_text(KITTI)
    return folder / "left.png", folder / "right.png", folder / "calib.txt"


@pytest.mark.parametrize(("kind", "make"), [("kitti", make_kitti), ("middlebury", make_middlebury)])
def test_a_kind_is_recognised_or_named(tmp_path: Path, kind: str, make: type) -> None:
    folder = make(tmp_path / "folder")
    assert recognise_source(folder) == kind
    for source in (open_source(folder), open_source(folder, kind)):
        assert source.name == "folder"
        assert folder / "calib.txt" in source.files
        assert len(source) == len(list(source)) == 1
        assert repr(source) == f"{type(source).__name__}(folder, pairs: 1, {source.description})"


def make_video(folder: Path) -> Path:
    write_calib(folder, CAMERA)
    return write_video(folder / "left.avi", [image(64)] * 3)


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("make", [make_kitti, make_middlebury, make_video])
def test_a_name_of_a_camera_where_nothing_is_named_is_refused(
    tmp_path: Path, make: Callable[[Path], Path], side: str
) -> None:
    path = make(tmp_path / "in")
    ended = run("map", path, f"--{side}", "X", "--out", tmp_path / "out")
    found = "X: file does not exist" if make is make_video else f"got --{side} X); leave it out"
    assert_refused(ended, found if side == "right" else f"got --{side} X); leave it out")


def test_a_middlebury_scene_has_its_geometry_one_frame_and_no_path(tmp_path: Path) -> None:
    folder = make_middlebury(tmp_path)
    source = open_source(folder, settings=SourceSettings(end=1))
    assert (source.calibration.baseline_m, source.calibration.doffs_px) == (0.5, 2)
    assert source.truth is None
    assert source.calibration.ndisp == 20
    assert (len(list(source)), len(list(source.frames(1)))) == (1, 0)
    with pytest.raises(SourceError, match="no frame is chosen"):
        open_source(folder, settings=SourceSettings(start=1))


def test_a_middlebury_scene_without_published_geometry_is_refused(tmp_path: Path) -> None:
    for name in ("im2.png", "im6.png"):
        write_image(tmp_path / name, image())
    with pytest.raises(CalibrationError, match=r"no calibration is published.*expected calib\.txt"):
        open_source(tmp_path)


def test_one_pair_of_files_is_read_with_its_calibration(tmp_path: Path) -> None:
    given = read_pair_input(*make_files(tmp_path))
    assert given.pair.name == "left.png"
    assert [path.name for path in given.files] == ["left.png", "right.png", "calib.txt"]
    assert given.calibration.baseline_m == 0.5


def test_a_grey_and_a_coloured_image_make_a_coloured_pair(tmp_path: Path) -> None:
    write_image(tmp_path / "l.png", image())
    write_image(tmp_path / "r.png", image(colour=True))
    pair = read_pair(tmp_path / "l.png", tmp_path / "r.png")
    assert pair.left.shape == pair.right.shape == (16, 32, 3)
    np.testing.assert_array_equal(pair.left[:, :, 1], image())


def test_files_of_different_size_are_refused_with_both_sizes(tmp_path: Path) -> None:
    files = make_files(tmp_path, right_width=31)
    with pytest.raises(SourceError, match=r"right\.png: .*got left 32x16, right 31x16"):
        read_pair_input(*files)


@pytest.mark.parametrize("name", ["left.png", "right.png", "calib.txt"])
def test_a_missing_file_of_a_pair_is_named(tmp_path: Path, name: str) -> None:
    files = make_files(tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises(FormatError, match=rf"{name}: file does not exist"):
        read_pair_input(*files)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none", "folder does not exist"),
        ("notes.txt", "file is not a source of stereo pairs.*KITTI drive.*Middlebury scene"),
        ("empty", "folder is empty"),
        ("other", "folder is not a source of stereo pairs.*KITTI drive.*Middlebury scene"),
    ],
)
def test_what_is_no_source_is_one_clear_line(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "other").mkdir()
    for path in (tmp_path / "notes.txt", tmp_path / "other" / "notes.txt"):
        path.write_text("x")
    with pytest.raises(SourceError, match=rf"{name}: {message}"):
        open_source(tmp_path / name)


def test_an_unknown_kind_gets_the_choices(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"got rosbag, expected bag, euroc, kitti-raw, "):
        open_source(tmp_path, "rosbag")


def test_half_a_drive_is_reported_as_a_drive_and_not_as_unknown(tmp_path: Path) -> None:
    folder = make_kitti(tmp_path)
    (folder / "image_1" / "000000.png").unlink()
    (folder / "image_1").rmdir()
    with pytest.raises(SourceError, match="folder of the other camera is missing"):
        open_source(folder)


@pytest.mark.real
@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("driven/kitti_06_51", "kitti"),
        ("middlebury/MiddEval3/trainingQ/Piano", "middlebury"),
        ("middlebury/2005/Art", "middlebury"),
        ("middlebury/2003/Cones", None),
    ],
)
def test_real_folders_are_recognised(recon_data: Path, path: str, kind: str | None) -> None:
    if kind is None:
        with pytest.raises(ReconError, match="no calibration is published"):
            open_source(recon_data / path)
    else:
        assert recognise_source(recon_data / path) == kind
        assert len(open_source(recon_data / path)) > 0

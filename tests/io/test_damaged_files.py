"""Damaged files of every format: one clear line that names the file, and the row if any."""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import CalibrationError, FormatError, ReconError, ShapeError
from recon.core.geometry.se3 import make_transform
from recon.core.values import FREE, CameraIntrinsics, OccupancyGrid, StereoCalibration
from recon.io.cameras.calibration import read_calibration, write_recon_calibration
from recon.io.cameras.kitti import read_kitti_calib
from recon.io.cameras.ros import read_euroc_truth, write_kalibr
from recon.io.fields import read_toml, read_yaml
from recon.io.files import read_table, read_text
from recon.io.images.disparity import read_pfm
from recon.io.images.image import read_image
from recon.io.middlebury import read_middlebury_calib
from recon.io.models.mesh import read_mesh
from recon.io.models.octomap import read_octomap
from recon.io.models.ply import read_ply
from recon.io.models.rasters import read_grid, write_nav2
from recon.io.trajectory import read_frames, read_trajectory

IDENTITY = b"1 0 0 0 0 1 0 0 0 0 1 0\n"
P0, P1 = b"P0: 700 0 600 0 0 700 180 0 0 0 1 0\n", b"P1: 700 0 600 -350 0 700 180 0 0 0 1 0\n"
PLY = b"ply\nformat ascii 1.0\n"
XYZ = b"property float x\nproperty float y\nproperty float z\n"
FACE = PLY + b"element vertex 3\n" + XYZ + b"element face 1\nproperty list uchar int vertex_index\n"
CORNERS = b"end_header\n0 0 0\n1 0 0\n0 1 0\n"

Row = tuple[bytes, str]
CORPUS: dict[str, tuple[Callable[[Path], object], list[Row]]] = {
    "times.txt": (read_text, [(b"", "file is empty"), (b"\xff\xfe", r"not a text.*byte 0 is not")]),
    "table.txt": (
        partial(read_table, columns=(2, 3)),
        [
            (b"1 2\n1 2 3\n", r":2: wrong number of columns \(got 3, expected 2\)"),
            (b"1 2 3\n1 2\n", r":2: wrong number of columns \(got 2, expected 3\)"),
            (b"1 2 3 4\n", r":1: wrong number of columns \(got 4, expected 2 or 3\)"),
            (b"1 2\n1 nan\n", r":2: number is not finite \(got 1 nan\)"),
            (b"1 x\n", r":1: not a number \(got 1 x\)"),
            (b"# nothing\n", ": file contains no numbers"),
        ],
    ),
    "config.yaml": (
        read_yaml,
        [(b"a: [1\nb: 2\n", ":2: not a YAML file"), (b"- 1\n", r"not a mapping \(got list\)")],
    ),
    "stereo.yml": (
        read_calibration,
        [
            (b"%YAML:1.0\n---\nM1: [1, 2\n", "not a YAML file"),
            (b"hello", ": not a calibration file of a known"),
            (b"<html></html>", ": not a calibration file of a known"),
        ],
    ),
    "jobs.toml": (read_toml, [(b"a = [1\n", ": not a TOML file")]),
    "frames.csv": (
        read_frames,
        [
            (b"# none\n", ": file lists no images"),
            (b"# a\nl.png,r.png,0\n", ":2: not two images and their times"),
            (b"l.png,r.png,0,inf\n", ":1: time is not finite"),
        ],
    ),
    "poses.txt": (
        read_trajectory,
        [
            (IDENTITY + IDENTITY[:-3] + b"\n", ":2: wrong number of columns .got 11, expected 12"),
            (IDENTITY + b"1 0 0 0 0 1 0 0 0 0 1 nan\n", ":2: number is not finite"),
            (b"2" + IDENTITY[1:], ":1: pose is not a rigid transform"),
            (b"1 0 0 0 0 1 0 0 0 0 -1 0\n", ":1: pose is not a rigid transform"),
            (IDENTITY + b"0 0 0 0 0 0 0 1\n", ":2: wrong number of columns .got 8, expected 12"),
            (b"1 2 3\n", ":1: wrong number of columns .got 3, expected 12 or 8"),
            (b"0 0 0 0 0 0 0 0\n", ":1: quaternion is not of unit length .got 0"),
            (b"2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", ":2: time runs backwards"),
            (b"1 0 0 1e30 0 1 0 0 0 0 1 0\n", r":1: position .*got 1e\+30 m"),
            (b"0 0 0 0 0 0 0 1\n0.5 0 -1e30 0 0 0 0 1\n", r":2: position .*got 1e\+30 m"),
        ],
    ),
    "data.csv": (
        read_euroc_truth,
        [(b"#t\n1,0,0,0,1,0,0,0\n2,0,0,1,0,0,0,0\n", ": pose 1 is not finite")],
    ),
    "calib.txt": (
        partial(read_kitti_calib, width_px=1242, height_px=375),
        [
            (P0, r"calibration has no P1 \(got P0\); a stereo pair needs"),
            (b"Tr: 1 2 3\n", r"calibration has no P0 \(got no projection matrix\)"),
            (P0 + b"P1: 1 2 3\n", r"'P1' is wrong \(got 3 numbers, expected 12 numbers"),
            (P0 + b"P1: " + b"x " * 12, "'P1' is wrong .*expected numbers"),
            (P0 + b"P1: " + b"nan " * 12, "'P1' is wrong .*expected finite numbers"),
            (P0 + b"P1: " + b"0 " * 12, "P1 is not the projection"),
            (P0 + P0.replace(b"P0", b"P1"), r"baseline is zero \(got 0 m, expected > 0 m"),
            (P0 + P1.replace(b"-350", b"350"), "right camera is to the left .*swap left and right"),
            (P0 + P1.replace(b"-350 0 700 180 0", b"0 0 700 180 -350"), "side by side.*vertical"),
            (P0.replace(b"700", b"-700") + P1, "focal length of P0 is not positive"),
            (P0 + P1.replace(b"700", b"800"), "P0 and P1 have different focal"),
        ],
    ),
    "disp0.pfm": (
        read_pfm,
        [
            (b"P5\n1 1\n255\n\x00", "not a PFM file"),
            (b"PF\n1 1\n-1\n" + bytes(12), "PFM file is in colour"),
            (b"Pf\n2 2\n-1\n" + bytes(12), r"truncated \(got 12 bytes, expected 16 for 2x2 pixel"),
            (b"Pf\n1 1\n0\n" + bytes(4), r"scale .* \(got 0\)"),
            (b"Pf\n1 1\n1-1\n" + bytes(4), r"scale .* \(got 1-1\)"),
        ],
    ),
    "left.png": (
        read_image,
        [
            (b"", "file is empty"),
            (b"hello, I am text", r"not an image \(expected PNG, JPEG, PGM, PPM, BMP or TIFF\)"),
            (b"\x89PNG\r\n\x1a\n", "PNG image is truncated .*ends after 8 bytes, before IEND"),
            (b"\x89PNG\r\n\x1a\n" + bytes(3) + b"\x09IHDR1234", "inside a chunk of 9 bytes"),
            (b"\xff\xd8\xff\xe0", "JPEG image is truncated"),
            (b"P5\n4 4\n255\nabc", r"PGM/PPM image is truncated or .* \(got 3 of 16 samples\)"),
            (b"P6\n2 2\n255\nabcdefghijk", "got 11 of 12 samples"),
            (b"P2\n2 2\n255\n1 2 3\n", "got 3 of 4 samples"),
            (b"P5\nfour", "no readable header"),
            (b"BM", "BMP image is truncated .*in its header"),
            (b"II*\x00garbage", "image cannot be decoded"),
        ],
    ),
    "cloud.ply": (
        read_ply,
        [
            (b"junk\nmore\n", "does not start with 'ply'"),
            (PLY, "cannot read the PLY header"),
            (PLY + b"comment\n" * 1000, "PLY header does not end"),
            (b"ply\nformat binary_middle_endian 1.0\nend_header\n", "cannot read the PLY header"),
            (b"ply\nelement vertex 0\nend_header\n", "no format line"),
            (PLY + b"property float x\nend_header\n", "cannot read the PLY header"),
            (PLY + b"element vertex 1\nproperty quad x\nend_header\n1\n", "the PLY header"),
            (PLY + b"element v 1\nproperty int x\nproperty int x\nend_header\n", "twice"),
            (PLY + b"element vertex 1\nproperty float x\nend_header\n1\n", "no vertices with x, y"),
            (PLY + b"element vertex 2\n" + XYZ + b"end_header\n1 2 3\n1 two 3\n", "got 1 row, exp"),
            (PLY + b"element vertex 2\n" + XYZ + b"end_header\n1 2 3\n1 2\n", "truncated"),
            (PLY + b"element vertex 1\n" + XYZ + b"end_header\nnan 0 0\n", "no point .* is finite"),
        ],
    ),
    "mesh.ply": (
        read_mesh,
        [
            (FACE + CORNERS + b"4 0 1 2 0\n", "truncated in its element 'face'"),
            (FACE + CORNERS + b"4 0 1 2\n", "a face is not a triangle"),
            (FACE + CORNERS + b"3 0 1 3\n", r"does not exist \(got 3, expected less than 3"),
            (FACE + CORNERS.replace(b"1 0 0", b"1 inf 0") + b"3 0 1 2\n", "is not finite"),
            (PLY + b"element vertex 1\n" + XYZ + b"end_header\n0 0 0\n", "it is a point cloud"),
        ],
    ),
    "mesh.xyz": (read_mesh, [(b"x", "unknown kind of mesh file")]),
    "map.ot": (
        read_octomap,
        [
            (b"", "not an .ot OctoMap"),
            (b"# Octomap OcTree file\nid OcTree\nsize 1\nres 0\ndata\n", "no occupancy octree"),
            (b"# Octomap OcTree file\nid Tree\nsize 1\nres 1\ndata\n", "no occu.*got .*Tree"),
            (b"# Octomap OcTree file\nid OcTree\nres 1\ndata\n", "truncated or damaged"),
        ],
    ),
    "grid.yaml": (
        read_grid,
        [(b"", "file is empty"), (b"a: [", "not a YAML"), (b"image: x.pgm", "no 'resolution'")],
    ),
}
ROWS = [
    pytest.param(name, content, message, id=f"{name}-{message[:30]}")
    for name, (_, rows) in CORPUS.items()
    for content, message in rows
]


def refusal(read: Callable[[Path], object], path: Path) -> str:
    with pytest.raises(ReconError) as caught:
        read(path)
    line = str(caught.value)
    assert "\n" not in line
    assert type(caught.value) in (FormatError, CalibrationError, ShapeError)
    return line


@pytest.mark.parametrize(("name", "content", "message"), ROWS)
def test_a_damaged_file_is_one_clear_line(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    assert re.search(rf"{re.escape(name)}.*{message}", refusal(CORPUS[name][0], tmp_path / name))


@pytest.mark.parametrize("name", CORPUS)
def test_what_is_no_file_is_named(tmp_path, name):
    for path in (tmp_path / name, tmp_path):
        words = r"file does not exist|cannot read the file|no such file|not an|unknown kind"
        assert re.search(rf"{path.name}: ({words})", refusal(CORPUS[name][0], path))


def _rig() -> StereoCalibration:
    matrix, lens = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), [-0.3, 0.1, 1e-3, -2e-5]
    camera = CameraIntrinsics(matrix, np.array(lens), 640, 480)
    return StereoCalibration(camera, camera, make_transform(np.eye(3), np.array([-0.12, 0, 0])))


def _write_middlebury(path: Path) -> None:
    cameras = "cam0=[999.421 0 294.182; 0 999.421 252.932; 0 0 1]\n"
    cameras += "cam1=[999.421 0 326.96; 0 999.421 252.932; 0 0 1]\n"
    path.write_text(cameras + "doffs=32.778\nbaseline=193.001\nwidth=24\nheight=12\nndisp=70\n")


VALID: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "ours.yaml": (partial(write_recon_calibration, calibration=_rig()), read_calibration),
    "chain.yaml": (partial(write_kalibr, calibration=_rig()), read_calibration),
    "calib.txt": (_write_middlebury, read_middlebury_calib),
    "grid.yaml": (
        lambda path: write_nav2(
            path.with_suffix(""), OccupancyGrid(np.full((2, 3), FREE, np.int8), 0.2, (0.0, 1.0))
        ),
        read_grid,
    ),
}


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("ours.yaml", "fx_px: 500.0", "fx_px: many", "'left.fx_px' is wrong .*many"),
        ("ours.yaml", "fx_px: 500.0", "f: 500.0", "calibration has no 'left.fx_px'"),
        ("ours.yaml", "fx_px: 500.0", "fx_px: -500.0", "focal length is not positive"),
        ("ours.yaml", "k2:", "k9:", "distortion has gaps"),
        ("ours.yaml", "version: 1", "version: 7", "version .* not supported"),
        ("ours.yaml", "kind: stereo", "kind: mono", "unknown kind"),
        ("ours.yaml", "model: pinhole", "model: pinhead", "unknown lens model"),
        ("ours.yaml", "width_px: 640", "width_px: 0.5", "'left.width_px' is wrong"),
        ("ours.yaml", "\nleft:", "\nleft: 1\nother:", "'left' is wrong .*a mapping"),
        ("chain.yaml", "camera_model: pinhole", "camera_model: cat", "not supported .*cat"),
        ("chain.yaml", "radtan", "sine", "lens model is not supported .*sine"),
        ("chain.yaml", "radtan", "none", "a lens without distortion has coefficients"),
        ("chain.yaml", "cam1:", "cam2:", "kalibr.*chain has no"),
        ("calib.txt", "cam1=", "cam2=", "calibration has no 'cam1'"),
        ("calib.txt", "baseline=193.001", "baseline=0", "baseline is zero"),
        ("calib.txt", "193.001", "wide", r"'baseline' is wrong \(got wide, expected numbers"),
        ("calib.txt", "width=24", "width=nan", "'width' is wrong .*finite numbers"),
        ("calib.txt", "cam0=[999.421 0", "cam0=[", "'cam0' is wrong .*expected 9 numbers"),
        ("calib.txt", "doffs=32.778", "doffs=31", r"doffs is .*got 31, expected 32\.778"),
        ("calib.txt", "999.421 0 326", "500 0 326", "different focal lengths"),
        ("grid.yaml", "trinary", "scale", r"mode .*got scale, expected trinary"),
        ("grid.yaml", "- 0.0\nneg", "- 0.5\nneg", r"rotated \(got yaw 0\.5"),
        ("grid.yaml", "resolution: 0.2", "resolution: here", "not a number"),
        ("grid.yaml", "negate", "negative", "no 'negate'"),
    ],
)
def test_a_spoiled_file_is_one_clear_line(tmp_path, name, old, new, message):
    write, read = VALID[name]
    path = tmp_path / name
    write(path)
    read(path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    assert re.search(rf"{re.escape(name)}: .*{message}", refusal(read, path))

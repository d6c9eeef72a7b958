"""Damaged files of every kind are read, or refused by an error of ours that names them."""

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from recon.commands.config import load_config
from recon.core.values import OccupancyGrid, OccupancyVoxels, PointCloud, StereoPair, TriangleMesh
from recon.io.cameras.calibration import read_calibration
from recon.io.cameras.named import read_euroc_camera
from recon.io.cameras.ros import read_euroc_truth
from recon.io.fields import read_yaml
from recon.io.images.disparity import read_disparity_png, read_pfm, write_pfm
from recon.io.images.image import read_image
from recon.io.models.mesh import read_mesh, write_mesh
from recon.io.models.octomap import read_octomap
from recon.io.models.ply import read_ply, write_ply
from recon.io.models.rasters import read_grid, write_nav2
from recon.io.trajectory import read_frames, read_trajectory
from recon.sources.registry import open_source
from recon.sources.times import read_dates, read_stamped_names
from recon.sources.video import open_video
from tests.hostile.calibrations import CAMERA_INFO, VALID
from tests.hostile.refusals import refusal
from tests.hostile.test_map_records import read_map, write_map
from tests.scenery.octomaps import write_octomap
from tests.sources.bags import Recording, write_bag
from tests.sources.drives import CAMERA, write_video
from tests.stereo.match.test_onnx_matcher import match, pair_of, write_network


@dataclass(frozen=True)
class Kind:
    """A kind of file: how a valid one is written, and how it is read to its end."""

    name: str
    write: Callable[[Path], Any]
    read: Callable[[Path], Any]
    every: int = 1  # one of so many cases is tried of files that take long to read


def _rng() -> np.random.Generator:
    return np.random.default_rng(7)


def _cloud() -> PointCloud:
    xyz, rgb = _rng().normal(size=(20, 3)), _rng().integers(0, 255, (20, 3), np.uint8)
    confidence = np.full(20, 0.5, np.float32)
    return PointCloud(xyz.astype(np.float32), rgb=rgb, confidence=confidence, frame="map")


def _octomap(path: Path) -> None:
    keys = np.unique(_rng().integers(-20, 20, (50, 3), np.int32), axis=0)
    odds = np.where(np.arange(len(keys)) % 2, 0.8, -0.4).astype(np.float32)
    write_octomap(path.with_suffix(""), OccupancyVoxels(keys, odds, 0.1))


def _grid(path: Path) -> None:
    cells = np.array([[0, 100, -1], [0, 0, 100]], np.int8)
    write_nav2(path.with_suffix(""), OccupancyGrid(cells, 0.1, (0.0, 0.0)))


def _read_video(path: Path) -> None:
    video = open_video(path)
    list(video.pick(range(video.frames)))


def _calibration(content: str) -> Callable[[Path], Any]:
    def write(path: Path) -> None:
        path.write_text(content)
        path.with_name("rig_left.yaml").write_text(CAMERA_INFO.replace("SHIFT", "0"))

    return write


def _bag(path: Path) -> None:
    images = _rng().integers(0, 256, (2, 2, 32, 64), dtype=np.uint8)
    pairs = [StereoPair(*both, 0.1 * index, index) for index, both in enumerate(images)]
    with tempfile.TemporaryDirectory() as folder:
        shutil.move(write_bag(pairs, CAMERA, Path(folder), Recording("ros1")), path)


_MESH: Final = TriangleMesh(
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32),
    np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]], np.int32),
)
_IMAGE: Final = _rng().integers(0, 255, (9, 13, 3), np.uint8)
_SENSOR: Final = """\
T_BS: {cols: 4, rows: 4, data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
intrinsics: [50.0, 50.0, 24.0, 16.0]
resolution: [48, 32]
distortion_model: radial-tangential
distortion_coefficients: [0.0, 0.0, 0.0, 0.0]
"""

TEXTS: Final[dict[str, tuple[str, str, Callable[[Path], Any]]]] = {
    "euroc sensor": ("sensor.yaml", _SENSOR, read_euroc_camera),
    "euroc truth": ("data.csv", "#t\n1,0,0,0,1,0,0,0\n2,0,0,1,1,0,0,0\n", read_euroc_truth),
    "kitti poses": ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, read_trajectory),
    "tum poses": ("tum.txt", "0 0 0 0 0 0 0 1\n1 0 0 1 0 0 0 1\n", read_trajectory),
    "frames": ("frames.csv", "# a\nl/0.png,r/0.png,0.0,0.0\n", read_frames),
    "stamps": ("data.csv", "1403636579763555584,a.png\n", partial(read_stamped_names, unit_s=1e-9)),
    "dates": ("timestamps.txt", "2011-09-26 13:02:25.964389445\n" * 2, read_dates),
    "settings": ("c.yaml", "matching: {window_px: 9}\n", load_config),
    "yaml": ("y.yaml", "a: [1, 2]\nb: &b {c: 1.5}\nd: *b\n", read_yaml),
    "pgm, ascii": ("i.pgm", "P2 3 2 255\n1 2 3 4 5 6\n", read_image),
}
KINDS: Final[dict[str, Kind]] = {
    **{
        f"calibration {kind}": Kind(
            name, _calibration(content), partial(read_calibration, width_px=48, height_px=32)
        )
        for kind, (name, content) in VALID.items()
    },
    **{
        kind: Kind(name, lambda path, content=content: path.write_text(content), read)
        for kind, (name, content, read) in TEXTS.items()
    },
    **{
        suffix: Kind(f"i.{suffix}", lambda p: cv2.imwrite(str(p), _IMAGE), read_image)
        for suffix in ("png", "jpg", "tiff", "bmp", "ppm")
    },
    "disparity png": Kind(
        "d.png",
        lambda p: cv2.imwrite(str(p), _IMAGE[:, :, 0].astype(np.uint16) * 9),
        read_disparity_png,
    ),
    "pfm": Kind("d.pfm", lambda p: write_pfm(p, np.ones((4, 5), np.float32)), read_pfm),
    "ply": Kind("c.ply", lambda p: write_ply(p, _cloud()), read_ply),
    "ply, ascii": Kind("c.ply", lambda p: write_ply(p, _cloud(), ascii=True), read_ply),
    "mesh ply": Kind("m.ply", lambda p: write_mesh(p, _MESH), read_mesh),
    **{
        f"mesh {suffix}": Kind(f"m.{suffix}", lambda p: write_mesh(p, _MESH), read_mesh, every)
        for suffix, every in (("obj", 4), ("stl", 1), ("glb", 1))
    },
    "bag": Kind("d.bag", _bag, lambda p: list(open_source(p)), 10),
    "network": Kind(
        "n.onnx",
        lambda p: write_network(p, ["left", "right"], [(["left", "right"], "d", "Sub")]),
        lambda p: match(p, pair_of(30, 10, (8, 12))),
    ),
    "octomap ot": Kind("o.ot", _octomap, read_octomap),
    "nav2": Kind("g.yaml", _grid, read_grid),
    "nav2 image": Kind("g.pgm", _grid, lambda p: read_grid(p.with_suffix(".yaml"))),
    "map": Kind("map.recon", write_map, read_map, 4),
    "video": Kind("v.avi", lambda p: write_video(p, [_IMAGE[..., 0]] * 3, "MJPG"), _read_video),
}

#: What may have happened to a whole file on its way.
WHOLE: Final[tuple[Callable[[bytes], bytes], ...]] = (
    lambda content: content.decode("latin-1").encode("utf-16"),
    lambda content: content + "# é\n".encode("latin-1"),
    lambda content: bytes(range(256)) * 8,
    lambda content: b"\x89PNG\r\n\x1a\n" + bytes(200),
    lambda content: content + b" " * 5_000_000,
    lambda content: content.replace(b" ", b"\t"),
    lambda content: content.replace(b"50", b"fifty"),
    lambda content: content.replace(b"50", b"1e300"),
    lambda content: b"\n".join(content.split(b"\n")[::-1]),
    lambda content: content.replace(b",", b"").replace(b";", b""),
)

#: Pieces that parsers stumble over, to be put anywhere.
TOKENS: Final = (
    *(b"\0", b"\xff", b"\r\n", b"\n\n", b"\xef\xbb\xbf", b"\xff\xfe", b" ", b"-", b"9" * 40),
    *(b"9" * 5000, b"nan", b"inf", b"-1", b"1e999", b"1e-300", b"[" * 300, b"{" * 300, b"- " * 300),
    *(b"&a [*a]", b"!!int x", b"2020-13-45", b"%YAML:1.0\n", b"#", b"'", b'"', b"%", b"\\", b"*"),
    *(b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x80\x00\x00\x00", "\u00b2\u0661".encode()),
)


def damage(draw: st.DrawFn, content: bytes) -> bytes:
    data = bytearray(content)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data)))
        length = draw(st.integers(1, 64))
        match draw(st.sampled_from(["cut", "drop", "insert", "flip", "repeat", "swap", "noise"])):
            case "cut":
                del data[at:]
            case "drop":
                del data[at : at + length]
            case "insert":
                data[at:at] = draw(st.sampled_from(TOKENS))
            case "flip" if at < len(data):
                data[at] ^= 1 << draw(st.integers(0, 7))
            case "repeat":
                data[at:at] = bytes(data[at : at + length]) * draw(st.integers(1, 20))
            case "swap":
                data[at : at + 4] = data[at : at + 4][::-1]
            case "noise":
                data[at : at + length] = draw(st.binary(min_size=length, max_size=length))
    return bytes(data)


# Few where the examples are always the same; `make fuzz` searches long.
EXAMPLES: Final = 25 if settings.default.derandomize else 300


def written(kind: Kind, folder: Path) -> bytes:
    kind.write(folder / kind.name)
    kind.read(folder / kind.name)
    return (folder / kind.name).read_bytes()


def check(kind: Kind, path: Path, content: bytes) -> None:
    path.write_bytes(content)
    line = refusal(lambda: kind.read(path))
    assert line is None or path.stem in line, line


@pytest.mark.parametrize("name", KINDS)
def test_a_file_cut_anywhere_is_read_or_refused(name, tmp_path):
    kind = KINDS[name]
    content = written(kind, tmp_path)
    for length in range(0, len(content), max(1, kind.every * len(content) // 40)):
        check(kind, tmp_path / kind.name, content[:length])


@pytest.mark.parametrize("name", KINDS)
def test_a_file_changed_anywhere_is_read_or_refused(name, tmp_path):
    kind = KINDS[name]
    content = written(kind, tmp_path)
    for change in WHOLE:
        check(kind, tmp_path / kind.name, change(content))
    step = max(1, len(content) // 3)
    for at in range(0, len(content), step):
        for token in TOKENS[:: kind.every]:
            check(kind, tmp_path / kind.name, content[:at] + token + content[at + len(token) :])


@pytest.mark.parametrize(
    "name", [name for name in KINDS if KINDS[name].every == 1 or not settings.default.derandomize]
)
@given(data=st.data())
@settings(
    max_examples=EXAMPLES, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)
def test_a_damaged_file_is_read_or_refused(name, data):
    kind = KINDS[name]
    with tempfile.TemporaryDirectory() as folder:
        content = written(kind, Path(folder))
        damaged = data.draw(st.composite(lambda draw: damage(draw, content))())
        check(kind, Path(folder) / kind.name, damaged)

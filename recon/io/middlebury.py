"""Middlebury stereo scenes of 2001, 2003, 2005, 2006, 2014 and MiddEval3, with their truth.

Ref: https://vision.middlebury.edu/stereo/data/
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np

from recon.core.errors import CalibrationError, FormatError
from recon.core.values import DisparityTruth, RectifiedCamera, StereoPair, check_size
from recon.core.values.arrays import Float32, UInt8, size_text
from recon.io.fields import Fields
from recon.io.files import StrPath, read_table, read_text, reader, resolved
from recon.io.images.disparity import read_disparity_png, read_pfm
from recon.io.images.image import read_grey_levels, read_image

Generation = Literal["2001", "2003", "2005", "2014"]

_IMAGES: Final = (".png", ".ppm", ".pgm", ".jpg")
_MASKS: Final = ("mask0nocc.png", "mask_nocc_derived.png", "v2eval/nonocc.png", "nonocc.png")
_SEEN_BY_BOTH: Final = 255
_TOLERANCE_PX: Final = 1.0
_VARIANT: Final = re.compile(r"(Illum|Exp)\d+", re.IGNORECASE)
_CALIB_LINE: Final = re.compile(r"^\s*(\w+)\s*=\s*(.*?)\s*$", re.MULTILINE)
_2003_FACTORS: Final = {1800: 1.0, 900: 2.0, 450: 4.0}
# Ref: https://vision.middlebury.edu/stereo/data/scenes2005/ and scenes2006/, at full size.
_2005_FOCAL_PX: Final = 3740.0
_2005_BASELINE_M: Final = 0.160
_2005_FULL_HEIGHT_PX: Final = 1110
_EVAL3_FACTORS: Final = {"F": 1.0, "H": 2.0, "Q": 4.0}
_EVAL3_WIDTHS_PX: Final = {"ArtL": 1390, "Computer": 1330, "Teddy": 1800}
_EVAL3_WIDTH_PX: Final = 2800
_EVAL3_SCENES: Final = frozenset({
    "Adirondack", "ArtL", "Jadeplant", "Motorcycle", "MotorcycleE", "Piano", "PianoL", "Pipes",
    "Playroom", "Playtable", "PlaytableP", "Recycle", "Shelves", "Teddy", "Vintage",
    "Australia", "AustraliaP", "Bicycle2", "Classroom2", "Classroom2E", "Computer", "Crusade",
    "CrusadeP", "Djembe", "DjembeL", "Hoops", "Livingroom", "Newkuba", "Plants", "Staircase",
})  # fmt: skip


@dataclass(frozen=True)
class Layout:
    """Stems of images and of their truth (PFM if ``calibrated``, else ``levels`` per pixel)."""

    left: str
    right: str
    truth_left: str
    truth_right: str
    levels: float = 8.0
    calibrated: bool = False


_TSUKUBA: Final = Layout("im3", "im4", "disp3", "disp4", levels=16.0)
_TSUKUBA_2001: Final = Layout(
    "scene1.row3.col3", "scene1.row3.col4", "truedisp.row3.col3", "truedisp.row3.col4", levels=16.0
)
_MAP: Final = Layout("im0", "im1", "disp0", "disp1")
_2001_2003: Final = Layout("im2", "im6", "disp2", "disp6")
_2005: Final = Layout("view1", "view5", "disp1", "disp5")
_2014: Final = Layout("im0", "im1", "disp0", "disp1", calibrated=True)
_EVAL3: Final = Layout("im0", "im1", "disp0GT", "disp1GT", calibrated=True)


@dataclass(frozen=True, eq=False)
class MiddleburyScene:
    """One scene with all data of its folder; its years are those of the layout."""

    name: str
    generation: Generation  # "2005" includes 2006, and "2014" includes MiddEval3
    pair: StereoPair
    camera: RectifiedCamera | None  # None = not published: 2001, 2003, or without ``dmin.txt``
    truth: DisparityTruth | None  # of the left image
    ndisp: int | None  # number of disparities to search; None = not published
    isint: bool  # whether results are rounded to whole pixels before comparison
    full_size_factor: float  # full-size pixels, in which the benchmark counts, per pixel of these


@reader
def read_middlebury_scene(folder: StrPath) -> MiddleburyScene:
    """Read one scene of any year.

    Raises:
        FormatError: The folder is not a scene, or a file is missing, damaged or of another size.
        CalibrationError: The calibration cannot give depth.
    """
    path = resolved(folder)
    layout = find_layout(path)
    if layout is None:
        expected = "im0 and im1 with calib.txt, view1 and view5, im2 and im6, or im3 and im4"
        raise FormatError("folder is not a Middlebury scene", expected=expected)
    pair = _read_pair(path, layout)
    height_px, width_px = pair.left.shape[:2]
    units, root = units_of(layout, width_px, height_px, path), scene_root(path)
    calib = _read_calib(root, units, width_px, height_px)
    ndisp, info = calib.camera.ndisp if calib else None, path / "v2eval" / "info.txt"
    if calib is None and info.is_file():  # of version 2: grey levels per pixel, largest disparity
        ndisp = int(read_table(info, (1, 2))[0].ravel()[-1]) + 1
    return MiddleburyScene(
        name=path.name,
        generation=units.generation,
        pair=pair,
        camera=calib.camera if calib else None,
        truth=_read_truth(root, layout, units.levels, (height_px, width_px)),
        ndisp=ndisp,
        isint=calib.isint if calib else False,
        full_size_factor=units.factor,
    )


def find_layout(folder: Path) -> Layout | None:
    """Return the layout that matches the files of a folder, or None; one of the images suffices."""

    def with_image(*layouts: Layout) -> Layout | None:
        images = ((one, stem) for one in layouts for stem in (one.left, one.right))
        return next((one for one, stem in images if find_image(folder, stem)), None)

    if (folder / "disp0GT.pfm").is_file():
        return with_image(_EVAL3)
    if (folder / "calib.txt").is_file() or (folder / "disp0.pfm").is_file():
        return with_image(_2014)
    older = with_image(_2005, _2001_2003, _TSUKUBA, _TSUKUBA_2001)
    return older or (with_image(_MAP) if find_image(folder, _MAP.truth_left) else None)


def find_image(folder: Path, stem: str) -> Path | None:
    """Return the image file with that stem and any image suffix, or None."""
    paths = (folder / f"{stem}{suffix}" for suffix in _IMAGES)
    return next((path for path in paths if path.is_file()), None)


def scene_root(folder: Path) -> Path:
    """Return the folder with the truth: above those by lighting and exposure of 2005 and 2006."""
    while _VARIANT.fullmatch(folder.name):
        folder = folder.parent
    return folder


def _read_pair(path: Path, layout: Layout) -> StereoPair:
    images = []
    for stem in (layout.left, layout.right):
        if (file := find_image(path, stem)) is None:
            raise FormatError("image is missing", where=path, expected=f"{stem}.png")
        images.append(read_image(file))
    left, right = images
    if left.shape != right.shape:
        got = f"{layout.left} {size_text(left)}, {layout.right} {size_text(right)}"
        raise FormatError("left and right images differ in size", where=path, got=got)
    return StereoPair(left, right, name=path.name)


class Units(NamedTuple):
    """The year of a scene, grey levels per pixel of its truth, full-size pixels per pixel."""

    generation: Generation
    levels: float | None
    factor: float


def units_of(layout: Layout, width_px: int, height_px: int, folder: Path) -> Units:
    """Return the units of a scene; scenes of 2001 and 2003 are told apart by their width."""
    if layout.calibrated:
        return Units("2014", None, _factor_of_2014(folder, width_px))
    if layout == _2005:
        factor = float(max(1, round(_2005_FULL_HEIGHT_PX / height_px)))
        return Units("2005", factor, factor)
    if layout == _2001_2003 and width_px in _2003_FACTORS:
        factor = _2003_FACTORS[width_px]
        return Units("2003", factor, factor)
    return Units("2001", layout.levels, 1.0)


def _factor_of_2014(folder: Path, width_px: int) -> float:
    """Return what MiddEval3 says by the last letter of ``trainingQ``, else by scene and width."""
    collection = folder.parent.name
    if collection.startswith(("training", "test")):
        return _EVAL3_FACTORS.get(collection[-1], 1.0)
    if folder.name not in _EVAL3_SCENES:
        return 1.0
    full_px = _EVAL3_WIDTHS_PX.get(folder.name, _EVAL3_WIDTH_PX)
    return 2.0 ** min(max(round(math.log2(full_px / width_px)), 0), 2)


@dataclass(frozen=True)
class MiddleburyCalib:
    """The content of a ``calib.txt``, metres; ``doffs_px`` is as in the file, if there."""

    camera: RectifiedCamera
    isint: bool = False
    doffs_px: float | None = None


@reader
def read_middlebury_calib(path: StrPath) -> MiddleburyCalib:
    """Read a ``calib.txt`` of the 2014 data or of MiddEval3."""
    fields = Fields(dict(_CALIB_LINE.findall(read_text(path))))
    cam0, cam1 = (fields.numbers(key, (3, 3)) for key in ("cam0", "cam1"))
    doffs_px = fields.number("doffs")
    if not np.allclose(cam0[[0, 1, 1], [0, 1, 2]], cam1[[0, 1, 1], [0, 1, 2]], rtol=1e-4):
        raise CalibrationError("cam0 and cam1 have different focal lengths or rows")
    apart_px = cam1[0, 2] - cam0[0, 2]
    # Each value is printed with three decimals.
    if abs(apart_px - doffs_px) > 0.01:
        what = "doffs is not the difference of the principal points"
        raise CalibrationError(what, got=f"{doffs_px:g}", expected=f"{apart_px:g}")
    size = (fields.count("width"), fields.count("height"))
    camera = RectifiedCamera.from_matrices(cam0, cam1, fields.number("baseline") / 1000, *size)
    if "ndisp" in fields:
        camera = replace(camera, ndisp=fields.count("ndisp"))
    isint = "isint" in fields and fields.number("isint") != 0
    return MiddleburyCalib(camera, isint, doffs_px)


def _read_calib(path: Path, units: Units, width_px: int, height_px: int) -> MiddleburyCalib | None:
    if units.generation == "2005" and (path / "dmin.txt").is_file():
        dmin_px = float(read_table(path / "dmin.txt", (1,))[0][0, 0])
        return MiddleburyCalib(nominal_camera_2005(width_px, height_px, dmin_px, units.factor))
    if units.generation != "2014" or not (path / "calib.txt").is_file():
        return None
    calib = read_middlebury_calib(path / "calib.txt")
    check_size(calib.camera, width_px, height_px, path / "calib.txt")
    return calib


def nominal_camera_2005(
    width_px: int, height_px: int, dmin_px: float, factor: float
) -> RectifiedCamera:
    """Return the camera of 2005 or 2006; disparities are ``dmin_px`` full-size pixels too small."""
    camera = stand_in_camera(width_px, height_px)
    focal_px, cx_right_px = _2005_FOCAL_PX / factor, camera.cx_px + dmin_px / factor
    return replace(camera, focal_px=focal_px, cx_right_px=cx_right_px, baseline_m=_2005_BASELINE_M)


def stand_in_camera(width_px: int, height_px: int, ndisp: int | None = None) -> RectifiedCamera:
    """Return a camera for matching alone, not for depth: focal length = width, baseline 1."""
    cx_px, cy_px = (width_px - 1) / 2, (height_px - 1) / 2
    return RectifiedCamera(float(width_px), cx_px, cy_px, cx_px, 1.0, width_px, height_px, ndisp)


def _read_truth(
    folder: Path, layout: Layout, levels: float | None, shape: tuple[int, int]
) -> DisparityTruth | None:
    """Read the truth of the left image, and by a mask or that of the right one what both see."""
    values = _read_disparity(folder, layout.truth_left, levels, shape)
    if values is None:
        return None
    seen = np.ones(shape, bool)
    mask = next((folder / name for name in _MASKS if (folder / name).is_file()), None)
    if mask is not None:
        grey = read_grey_levels(mask)
        _check_shape(mask, grey, shape)
        seen = np.asarray(grey == _SEEN_BY_BOTH)
    elif (right := _read_disparity(folder, layout.truth_right, levels, shape)) is not None:
        # Where both disparities describe the same point.
        width = values.shape[1]
        columns = np.rint(np.arange(width) - np.nan_to_num(values, nan=2.0 * width)).astype(
            np.int64
        )
        inside = (columns >= 0) & (columns < width)
        there = np.take_along_axis(right, np.clip(columns, 0, width - 1), axis=1)
        seen = np.asarray(inside & (np.abs(there - values) <= _TOLERANCE_PX))
    return DisparityTruth(values, np.isfinite(values) & seen)


def _read_disparity(
    folder: Path, stem: str, levels: float | None, shape: tuple[int, int]
) -> Float32 | None:
    path = folder / f"{stem}.pfm" if levels is None else find_image(folder, stem)
    if path is None or not path.is_file():
        return None
    values = read_pfm(path) if levels is None else read_disparity_png(path, scale=levels)
    _check_shape(path, values, shape)
    return values


def _check_shape(path: Path, image: Float32 | UInt8, expected: tuple[int, int]) -> None:
    if image.shape != expected:
        size, what = f"{expected[1]}x{expected[0]}", "size differs from the images"
        raise FormatError(what, where=path, got=size_text(image), expected=size)

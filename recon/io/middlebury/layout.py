"""The files of a Middlebury scene in each year's data set, and the units of its ground truth.

=========  ==================  ======================  =========================================
year       images              truth                   grey levels per pixel of disparity
=========  ==================  ======================  =========================================
2001       im3, im4 (Tsukuba)  disp3                   16
2001       scene1.row3.col3    truedisp.row3.col3      16 (Tsukuba as published)
2001       im2, im6            disp2, disp6            8
2001       im0, im1 (Map)      disp0, disp1            8
2003       im2, im6            disp2, disp6            4, 2, 1 at quarter, half, full size
2005/2006  view1, view5        disp1, disp5            3, 2, 1 at third, half, full size
2014       im0, im1, calib     disp0, disp1 (PFM)      floats, inf = unknown
MiddEval3  im0, im1, calib     disp0GT, disp1GT (PFM)  floats, inf = unknown
=========  ==================  ======================  =========================================

The images of 2005 and 2006 may be in subfolders by lighting and exposure (``Aloe/Illum1/Exp1``),
with the ground truth above them. ``calib.txt`` may be missing if the ground truth is PFM.

Ref: https://vision.middlebury.edu/stereo/data/
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

Generation = Literal["2001", "2003", "2005", "2014"]

_IMAGES: Final = (".png", ".ppm", ".pgm", ".jpg")
_2003_FACTORS: Final = {1800: 1, 900: 2, 450: 4}
_2005_FULL_HEIGHT_PX: Final = 1110
_EVAL3_FACTORS: Final = {"F": 1, "H": 2, "Q": 4}
_EVAL3_WIDTHS_PX: Final = {"ArtL": 1390, "Computer": 1330, "Teddy": 1800}
_EVAL3_WIDTH_PX: Final = 2800
_EVAL3_SCENES: Final = frozenset({
    "Adirondack", "ArtL", "Jadeplant", "Motorcycle", "MotorcycleE", "Piano", "PianoL", "Pipes",
    "Playroom", "Playtable", "PlaytableP", "Recycle", "Shelves", "Teddy", "Vintage",
    "Australia", "AustraliaP", "Bicycle2", "Classroom2", "Classroom2E", "Computer", "Crusade",
    "CrusadeP", "Djembe", "DjembeL", "Hoops", "Livingroom", "Newkuba", "Plants", "Staircase",
})  # fmt: skip
_VARIANT: Final = re.compile(r"(Illum|Exp)\d+", re.IGNORECASE)


@dataclass(frozen=True)
class Layout:
    """File stems of a scene.

    Attributes:
        left: Left image.
        right: Right image.
        truth_left: True disparity of the left image.
        truth_right: True disparity of the right image.
        calibrated: True if a ``calib.txt`` is expected and the ground truth is PFM.
    """

    left: str
    right: str
    truth_left: str
    truth_right: str
    calibrated: bool = False


_TSUKUBA: Final = Layout("im3", "im4", "disp3", "disp4")
_TSUKUBA_2001: Final = Layout(
    "scene1.row3.col3", "scene1.row3.col4", "truedisp.row3.col3", "truedisp.row3.col4"
)
_MAP: Final = Layout("im0", "im1", "disp0", "disp1")
_2001_2003: Final = Layout("im2", "im6", "disp2", "disp6")
_2005: Final = Layout("view1", "view5", "disp1", "disp5")
_2014: Final = Layout("im0", "im1", "disp0", "disp1", calibrated=True)
_EVAL3: Final = Layout("im0", "im1", "disp0GT", "disp1GT", calibrated=True)


def find_layout(folder: Path) -> Layout | None:
    """Return the layout that matches the files of a folder, or None; one of the images suffices."""
    marks = ("calib.txt", "disp0GT.pfm", "disp0.pfm")
    if any((folder / mark).is_file() for mark in marks):
        eval3 = (folder / "disp0GT.pfm").is_file()
        return (_EVAL3 if eval3 else _2014) if _has_image(folder, _2014) else None
    known = (_2005, _2001_2003, _TSUKUBA, _TSUKUBA_2001)
    layout = next((one for one in known if _has_image(folder, one)), None)
    if layout is None and _has_image(folder, _MAP) and find_image(folder, "disp0"):
        return _MAP
    return layout


def find_image(folder: Path, stem: str) -> Path | None:
    """Return the image file with that stem and any image suffix, or None."""
    paths = (folder / f"{stem}{suffix}" for suffix in _IMAGES)
    return next((path for path in paths if path.is_file()), None)


def generation_of(layout: Layout, width_px: int) -> Generation:
    """Return the year; scenes of 2001 and 2003 have the same file names and differ in width."""
    if layout.calibrated:
        return "2014"
    if layout == _2005:
        return "2005"
    return "2003" if layout == _2001_2003 and width_px in _2003_FACTORS else "2001"


def levels_per_pixel(layout: Layout, width_px: int, height_px: int) -> float | None:
    """Return grey levels per pixel of disparity in the ground truth; None = PFM."""
    generation = generation_of(layout, width_px)
    if generation == "2014":
        return None
    if generation == "2001":
        return 16.0 if layout in {_TSUKUBA, _TSUKUBA_2001} else 8.0
    return full_size_factor(layout, width_px, height_px, Path())


def scene_root(folder: Path) -> Path:
    """Return the folder of the scene itself, above any subfolders by lighting and exposure."""
    while _VARIANT.fullmatch(folder.name):
        folder = folder.parent
    return folder


def full_size_factor(layout: Layout, width_px: int, height_px: int, folder: Path) -> float:
    """Return full-size pixels per pixel of these images.

    MiddEval3 gives the size by the last letter of the collection (``trainingQ``); in other
    folders its scenes are recognised by name.
    """
    generation = generation_of(layout, width_px)
    if generation == "2003":
        return float(_2003_FACTORS[width_px])
    if generation == "2005":
        return float(max(1, round(_2005_FULL_HEIGHT_PX / height_px)))
    collection = folder.parent.name
    if generation == "2014" and collection.startswith(("training", "test")):
        return float(_EVAL3_FACTORS.get(collection[-1], 1))
    if generation == "2014" and folder.name in _EVAL3_SCENES:
        full_px = _EVAL3_WIDTHS_PX.get(folder.name, _EVAL3_WIDTH_PX)
        return 2.0 ** min(max(round(math.log2(full_px / width_px)), 0), 2)
    return 1.0


def _has_image(folder: Path, layout: Layout) -> bool:
    return any(find_image(folder, stem) for stem in (layout.left, layout.right))

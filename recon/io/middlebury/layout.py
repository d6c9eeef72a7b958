"""The files of a Middlebury scene in each year's data set, and the units of its ground truth.

Ref: https://vision.middlebury.edu/stereo/data/
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, NamedTuple

Generation = Literal["2001", "2003", "2005", "2014"]

_IMAGES: Final = (".png", ".ppm", ".pgm", ".jpg")
_2003_FACTORS: Final = {1800: 1.0, 900: 2.0, 450: 4.0}
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
_VARIANT: Final = re.compile(r"(Illum|Exp)\d+", re.IGNORECASE)


@dataclass(frozen=True)
class Layout:
    """Stems of the two images of a scene and of the true disparity of each.

    The truth is PFM where a ``calib.txt`` is expected, else grey: ``levels`` per pixel.
    """

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


class Units(NamedTuple):
    """The year of a scene, grey levels per pixel of its truth, full-size pixels per pixel."""

    generation: Generation
    levels: float | None
    factor: float


def find_layout(folder: Path) -> Layout | None:
    """Return the layout that matches the files of a folder, or None; one of the images suffices."""

    def has_image(layout: Layout) -> bool:
        return any(find_image(folder, stem) for stem in (layout.left, layout.right))

    if (folder / "disp0GT.pfm").is_file():
        return _EVAL3 if has_image(_EVAL3) else None
    if (folder / "calib.txt").is_file() or (folder / "disp0.pfm").is_file():
        return _2014 if has_image(_2014) else None
    known = [one for one in (_2005, _2001_2003, _TSUKUBA, _TSUKUBA_2001) if has_image(one)]
    if not known and has_image(_MAP) and find_image(folder, _MAP.truth_left):
        return _MAP
    return next(iter(known), None)


def find_image(folder: Path, stem: str) -> Path | None:
    """Return the image file with that stem and any image suffix, or None."""
    paths = (folder / f"{stem}{suffix}" for suffix in _IMAGES)
    return next((path for path in paths if path.is_file()), None)


def scene_root(folder: Path) -> Path:
    """Return the folder with the truth: above those by lighting and exposure of 2005 and 2006."""
    while _VARIANT.fullmatch(folder.name):
        folder = folder.parent
    return folder


def units_of(layout: Layout, width_px: int, height_px: int, folder: Path) -> Units:
    """Return the units of a scene; scenes of 2001 and 2003 are told apart by their width.

    In the truth of 2003 to 2006, a level is a pixel of the full size.
    """
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

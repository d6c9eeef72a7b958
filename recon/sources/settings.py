"""Settings of a source that cannot be derived from its files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from recon.core.errors import SourceError
from recon.core.settings import Settings
from recon.io.files import StrPath
from recon.io.images.image import MAX_MEGAPIXELS

SideBySide = Literal["left-right", "right-left", "top-bottom", "bottom-top"]
_Frame = Annotated[int, Field(ge=0, le=1_000_000_000)]


class SourceSettings(Settings):
    """How cameras, pairs and times are found in a source, where its layout leaves that open."""

    left: str | None = None
    """Left camera: a folder in the source, or a topic. none = found by name."""
    right: str | None = None
    """Right camera: a folder or topic, or the path of the right folder or video if the source is
    the left one. none = found by name."""
    calibration: str | None = None
    """Calibration file to use instead of that of the source. none = its own."""
    focal_px: float | None = Field(None, ge=1.0, le=1e6)
    """Focal length of images that are rectified already, with `source.baseline_m` in place of a
    calibration file. none = that of the calibration."""
    baseline_m: float | None = Field(None, ge=1e-6, le=1e6)
    """Distance between their cameras. none = see there."""
    cx_px: float | None = Field(None, ge=-1e6, le=1e6)
    """Column of their principal points. none = the middle."""
    cy_px: float | None = Field(None, ge=-1e6, le=1e6)
    """Row of it. none = the middle."""
    max_megapixels: float = Field(MAX_MEGAPIXELS, ge=1e-4, le=10_000.0)
    """Largest image that is read, in 10⁶ pixels; larger ones are refused before they are
    decoded."""
    metres_per_unit: float | None = Field(None, ge=1e-6, le=1e6)
    """Unit of the translation in an OpenCV calibration file: 0.001 for mm, 1 for metres; none =
    metres, and a baseline that is unusual is doubted."""
    pair_by: Literal["auto", "stamp", "name", "index"] = "auto"
    """How images of plain folders are paired. auto = by timestamps if the names have them, else by
    names if most have a partner, else by order."""
    tolerance_s: float = Field(0.01, ge=1e-9, le=1e6)
    """Largest difference between the timestamps of a pair."""
    rate_hz: float | None = Field(None, ge=1e-3, le=1e6)
    """Frame rate of a KITTI drive, plain folders or videos, in place of their times. none = their
    times, or 10 Hz for plain folders without times."""
    start: int = Field(0, ge=0, le=1_000_000_000)
    """First frame used; earlier ones are not read."""
    end: int | None = Field(None, ge=1, le=1_000_000_000)
    """Frame at which to stop, itself not used. none = the last."""
    stride: int = Field(1, ge=1, le=1_000_000_000)
    """Use every so many frames; the others are not read."""
    shift_frames: int = Field(0, ge=-1_000_000_000, le=1_000_000_000)
    """By how many frames the right camera is late: the left image of a frame is paired with the
    right one of so many frames later. Times, ground truth and known poses stay those of the left
    images. Negative = the left camera is late."""
    depth_per_metre: float = Field(5000.0, ge=1.0, le=1e6)
    """Value of a metre in the images of an RGB-D folder: 5000 in TUM's, 1000 where they are in
    millimetres."""
    poses_of: Literal["rectified", "raw"] = "rectified"
    """Which left camera known poses are of: the rectified one, as all that recon writes, or the one
    in front of the lens, as motion capture and other programs have it."""
    length: tuple[_Frame, _Frame, Annotated[float, Field(ge=1e-6, le=1e6)]] | None = None
    """Two frames of those used, counted from 0, and how far apart the left camera was in them,
    metres, such as [0, 143, 118.3]: it shows the baseline, and with it the scale. none = the
    baseline as calibrated."""
    side_by_side: SideBySide = "left-right"
    """Arrangement of the two views in the frames of one video, or of one camera. left-right =
    top-bottom, where the calibration fits that alone."""
    orientation: Literal["stored", "turned"] | None = None
    """Whether JPEG images are taken as the sensor stored them, or turned as their EXIF data say.
    none = whichever the calibration fits; images are refused where it fits both."""

    def named_in(self, folder: Path) -> tuple[Path, Path] | None:
        """Return the left and right file that are named of a folder; None = neither is."""
        if not (self.left or self.right):
            return None
        if not (self.left and self.right):
            what = "only one of the two cameras is named"
            got = f"--left {self.left}" if self.left else f"--right {self.right}"
            hint = "name them with --left and --right, or neither"
            raise SourceError(what, where=folder, got=got, hint=hint)
        return folder / self.left, folder / self.right

    def refuse_names(self, sides: Sequence[str], where: StrPath, hint: str) -> None:
        """Refuse names of cameras where the layout of the source leaves nothing to name."""
        named = [f"--{side} {name}" for side in sides if (name := getattr(self, side)) is not None]
        if named:
            what = "camera of this source cannot be named"
            raise SourceError(what, where=where, got=" ".join(named), hint=hint)

    @property
    def numbers(self) -> dict[str, float]:
        """What is known of rectified cameras instead of a calibration file, by setting."""
        given = {name: getattr(self, name) for name in ("focal_px", "baseline_m", "cx_px", "cy_px")}
        return {name: value for name, value in given.items() if value is not None}

    @property
    def has_camera(self) -> bool:
        """Whether the camera is known from here, not from the files of the source."""
        return self.calibration is not None or bool(self.numbers)

"""The kinds of source, and how the kind of a path is recognised."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from recon.core.errors import SourceError
from recon.io.files import StrPath, reading
from recon.io.images.video import VIDEOS
from recon.io.middlebury import find_layout
from recon.io.trajectory import FRAMES
from recon.sources.bag import BAGS, find_bags, open_bag
from recon.sources.folders import find_views, open_folders
from recon.sources.kitti import open_kitti, open_kitti_raw
from recon.sources.listed import list_files, open_euroc, open_tum
from recon.sources.one_pair import open_middlebury
from recon.sources.settings import SourceSettings
from recon.sources.source import StereoSource
from recon.sources.video import list_videos, open_video_source

SOURCES: Final[dict[str, Callable[[Path, SourceSettings], StereoSource]]] = {
    "kitti": open_kitti,
    "kitti-raw": open_kitti_raw,
    "euroc": open_euroc,
    "tum": open_tum,
    "folders": open_folders,
    "video": open_video_source,
    "bag": open_bag,
    "middlebury": open_middlebury,
}
EXPECTED: Final = (
    "a KITTI drive (odometry or raw), an EuRoC or TUM folder, left and right folders, videos, "
    "a ROS bag or MCAP file, or a Middlebury scene"
)


def open_source(
    path: StrPath, kind: str | None = None, settings: SourceSettings | None = None
) -> StereoSource:
    """Open a folder or file as a source of stereo pairs.

    Args:
        path: The folder or file.
        kind: A key of `SOURCES`; None = recognise it by its files.
        settings: What cannot be derived from its files.

    Raises:
        SourceError: The path is missing, empty, of an unknown kind, or gives no pairs.
        FormatError: A file in it is damaged.
        CalibrationError: Its calibration cannot give depth.
        MissingDependencyError: It is a bag, and the extra ``ros`` is not installed.
    """
    settings = settings or SourceSettings()
    with reading(path):
        if kind is None:
            kind = recognise_source(path, settings)
        if kind not in SOURCES:
            raise SourceError("unknown kind of source", got=kind, expected=", ".join(SOURCES))
        return SOURCES[kind](Path(path), settings)


def recognise_source(path: StrPath, settings: SourceSettings | None = None) -> str:
    """Recognise the kind of source (a key of `SOURCES`) of a path by its files."""
    place = Path(path)
    if place.is_file():
        return _recognise_file(place)
    if not place.is_dir():
        raise SourceError("folder does not exist", where=path)
    if not any(place.iterdir()):
        raise SourceError("folder is empty", where=path)
    kind = next((kind for kind, fits in _signs(place, settings or SourceSettings()) if fits), None)
    if kind is None:
        raise SourceError("folder is not a source of stereo pairs", where=path, expected=EXPECTED)
    return kind


def _recognise_file(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix in VIDEOS:
        return "video"
    if suffix in BAGS:
        return "bag"
    raise SourceError("file is not a source of stereo pairs", where=path, expected=EXPECTED)


def _signs(folder: Path, settings: SourceSettings) -> tuple[tuple[str, bool], ...]:
    """Return kinds and whether a folder looks like them, most distinctive first."""
    views = range(4)
    return (
        ("bag", bool(find_bags(folder))),
        ("euroc", any((f / "cam0" / "data.csv").is_file() for f in (folder / "mav0", folder))),
        ("kitti-raw", any((folder / f"image_{n:02d}" / "data").is_dir() for n in views)),
        ("folders", (folder / FRAMES).is_file()),
        ("middlebury", find_layout(folder) is not None),
        ("kitti", any((folder / f"image_{n}").exists() for n in views)),
        ("tum", bool(list_files(folder))),
        ("video", bool(list_videos(folder))),
        ("folders", find_views(folder, settings) is not None),
    )

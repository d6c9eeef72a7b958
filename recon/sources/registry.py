"""The kinds of source: one row each, in the order in which the kind of a path is recognised."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from recon.core.errors import SourceError
from recon.io.files import StrPath, reading
from recon.io.middlebury import find_layout
from recon.io.trajectory import FRAMES
from recon.sources.bag import BAGS, find_bags, open_bag
from recon.sources.calibration import RIG_FILE
from recon.sources.folders import find_views, open_folders
from recon.sources.images import ImageSource, open_fitting
from recon.sources.kitti import open_kitti, open_kitti_raw
from recon.sources.listed import DEPTH, is_euroc, list_files, open_euroc, open_rgbd, open_tum
from recon.sources.one_pair import open_middlebury
from recon.sources.settings import SourceSettings
from recon.sources.source import Recording, StereoSource
from recon.sources.video import VIDEOS, list_videos, open_video_source


class Kind(NamedTuple):
    """A kind of source: what it is called, how it is opened, and how it is recognised."""

    name: str
    what: str
    open: Callable[[Path, SourceSettings], StereoSource]
    fits: Callable[[Path, SourceSettings], object]  # whether a folder looks like it
    suffixes: frozenset[str] = frozenset()


_KITTI, _PLAIN = "a KITTI drive (odometry or raw)", "left and right folders"
KINDS: Final = (
    Kind("bag", "a ROS bag or MCAP file", open_bag, lambda at, _: find_bags(at), BAGS),
    Kind("euroc", "an EuRoC folder", open_euroc, lambda at, _: is_euroc(at)),
    Kind("kitti-raw", _KITTI, open_kitti_raw, lambda at, _: any(at.glob("image_0[0-3]/data"))),
    Kind("folders", _PLAIN, open_folders, lambda at, _: (at / FRAMES).is_file()),
    Kind("middlebury", "a Middlebury scene", open_middlebury, lambda at, _: find_layout(at)),
    Kind("kitti", _KITTI, open_kitti, lambda at, _: any(at.glob("image_[0-3]"))),
    Kind("rgbd", "an RGB-D folder", open_rgbd, lambda at, _: (at / DEPTH).is_file()),
    Kind("tum", "a TUM folder", open_tum, lambda at, _: list_files(at)),
    Kind("video", "videos", open_video_source, lambda at, _: list_videos(at), VIDEOS),
    Kind("folders", _PLAIN, open_folders, find_views),
)
"""The most distinctive first: what `recon capture` wrote has a list, and may look like others."""
_NAMELESS: Final = frozenset({"kitti", "kitti-raw", "middlebury"})  # their layouts name the cameras


def open_source(
    path: StrPath, kind: str | None = None, settings: SourceSettings | None = None
) -> StereoSource:
    """Open a folder or file as a source of stereo pairs, of a kind of `KINDS`; None = by its files.

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
        opening = {row.name: row.open for row in KINDS}
        if kind not in opening:
            raise SourceError("unknown kind of source", got=kind, expected=", ".join(opening))
        if kind in _NAMELESS:
            hint = "leave it out; --source folders takes image folders of any name"
            settings.refuse_names(("left", "right"), path, hint)
        source, turn = open_fitting(partial(opening[kind], Path(path)), settings, _first_image)
    if isinstance(source, ImageSource):
        source = replace(source, **turn)
    if not isinstance(source, Recording):
        return source

    def again(shift: int) -> StereoSource:
        return open_source(path, kind, settings.model_copy(update={"shift_frames": shift}))

    source, rig = replace(source, again=again), Path(path) / RIG_FILE
    if settings.has_camera or not rig.is_file():
        return source
    note = f"{rig} is not used: the drive has a calibration of its own; --calib takes it instead"
    return source if rig in source.texts else replace(source, notes=(*source.notes, note))


def _first_image(source: StereoSource) -> Path | None:
    return source.images[0].left if isinstance(source, ImageSource) else None


def recognise_source(path: StrPath, settings: SourceSettings | None = None) -> str:
    """Return the kind (a name of `KINDS`) that a folder or file looks like."""
    place = Path(path)
    is_file, settings = place.is_file(), settings or SourceSettings()
    if not is_file and not place.is_dir():
        hint = "recon live takes topics" if str(path).startswith("ros2:") else None
        raise SourceError("folder does not exist", where=path, hint=hint)
    if not is_file and not any(place.iterdir()):
        raise SourceError("folder is empty", where=path)
    for kind in KINDS:
        if place.suffix.lower() in kind.suffixes if is_file else kind.fits(place, settings):
            return kind.name
    what = f"{'file' if is_file else 'folder'} is not a source of stereo pairs"
    expected = ", ".join(dict.fromkeys(kind.what for kind in KINDS))
    raise SourceError(what, where=path, expected=expected)

"""Which kinds of source there are, and which of them a folder is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from recon.errors import SourceError
from recon.formats.files import StrPath
from recon.formats.middlebury_layout import find_layout
from recon.sources.kitti import KittiSource
from recon.sources.middlebury import MiddleburySource
from recon.sources.protocol import StereoSource

SOURCES: Final[dict[str, Callable[[StrPath], StereoSource]]] = {
    "kitti": KittiSource,
    "middlebury": MiddleburySource,
}


def open_source(path: StrPath, kind: str | None = None) -> StereoSource:
    """Open a folder as a source of stereo pairs.

    Args:
        path: The folder.
        kind: A key of `SOURCES`; None = recognise it by its files.

    Raises:
        SourceError: The folder is missing, empty or of no kind that is understood, or cannot
            give pairs.
        FormatError: A file in it is damaged.
        CalibrationError: Its calibration cannot give depth.
    """
    if kind is None:
        kind = recognise_source(path)
    if kind not in SOURCES:
        raise SourceError("unknown kind of source", got=kind, expected=", ".join(SOURCES))
    return SOURCES[kind](path)


def recognise_source(path: StrPath) -> str:
    """Tell by its files which kind of source (a key of `SOURCES`) a folder is.

    Raises:
        SourceError: The folder is missing, empty or of no kind that is understood.
    """
    folder = Path(path)
    if not folder.is_dir():
        what = "not a folder" if folder.exists() else "folder does not exist"
        raise SourceError(what, where=path)
    if not any(folder.iterdir()):
        raise SourceError("folder is empty", where=path)
    if find_layout(folder) is not None:
        return "middlebury"
    if any((folder / f"image_{camera}").exists() for camera in range(4)):
        return "kitti"
    raise SourceError(
        "folder is no source of stereo pairs",
        where=path,
        expected="a KITTI drive (image_0, image_1, calib.txt, times.txt) or a Middlebury scene",
    )

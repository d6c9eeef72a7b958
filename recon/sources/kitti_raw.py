"""Drives in the layout of KITTI's raw recordings, rectified (``_sync``) or not (``_extract``).

::

    2011_09_26/
      calib_cam_to_cam.txt            (or in the drive's folder)
      2011_09_26_drive_0013_sync/
        image_00/ image_01/           (or image_02, image_03)
          data/0000000000.png
          timestamps.txt              date and time, one line per image
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from recon.core.decimals import is_count
from recon.core.errors import SourceError
from recon.core.values import RectifiedCamera, Rig
from recon.core.words import counted
from recon.io.cameras.kitti import read_kitti_rig
from recon.io.files import resolved
from recon.sources.calibration import CALIBRATE, as_rectified, read_rig
from recon.sources.images import ImageSource, image_size, list_images, pair_listed
from recon.sources.kitti import choose_cameras
from recon.sources.settings import SourceSettings
from recon.sources.stamps import check_increasing
from recon.sources.times import read_dates

_CALIBRATION: Final = "calib_cam_to_cam.txt"


def open_kitti_raw(folder: Path, settings: SourceSettings) -> ImageSource:
    """Open a raw drive; its images are paired by timestamp."""
    cameras = choose_cameras(folder, "image_{:02d}")
    views = [folder / f"image_{camera:02d}" for camera in cameras]
    frames, listing = pair_listed([_read_list(v) for v in views], settings, folder)
    rig, calibration_files = _read_rig(
        folder, settings, cameras, image_size(frames[0].left, settings)
    )
    rectified = "rectified" if isinstance(rig, RectifiedCamera) else "not rectified"
    return ImageSource(
        name=resolved(folder).name,
        description=f"KITTI raw drive, {views[0].name} and {views[1].name}, {rectified}, "
        f"paired by stamps{listing}",
        calibration=rig,
        images=frames,
        listing=listing,
        texts=(*calibration_files, *(view / "timestamps.txt" for view in views)),
    )


def _read_list(view: Path) -> list[tuple[float, Path]]:
    """Return time and image of each frame; where images are missing, names give the frame."""
    path, images = view / "timestamps.txt", list_images(view / "data")
    if not path.exists():
        raise SourceError("times are missing", where=path)
    stamps = read_dates(path)
    check_increasing(stamps, str(path))
    if len(stamps) == len(images):
        return list(zip(stamps.tolist(), images, strict=True))
    if len(stamps) < len(images) or not all(is_count(image.stem) for image in images):
        raise SourceError(
            "numbers of times and images differ",
            where=path,
            got=counted(len(stamps), "time"),
            expected=f"{len(images)}",
        )
    named = {int(image.stem): image for image in images}
    missing = [view / "data" / f"{number:010d}.png" for number in range(len(stamps))]
    return [(stamp, named.get(k, missing[k])) for k, stamp in enumerate(stamps.tolist())]


def _read_rig(
    folder: Path, settings: SourceSettings, cameras: tuple[int, int], size: tuple[int, int]
) -> tuple[Rig, tuple[Path, ...]]:
    if settings.has_camera:
        return read_rig(settings, folder, size, cameras)
    candidates = [place / _CALIBRATION for place in (folder, resolved(folder).parent)]
    path = next((candidate for candidate in candidates if candidate.is_file()), None)
    if path is None:
        raise SourceError(
            "calibration is missing",
            where=folder,
            expected=f"{_CALIBRATION} in the folder of the drive or of its day",
            hint=f"download the calibration of the day, or {CALIBRATE}",
        )
    return as_rectified(read_kitti_rig(path, *size, cameras)), (path,)

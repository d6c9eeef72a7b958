"""Pictures of a rectification: epipolar lines before and after."""

from __future__ import annotations

from recon.io.atomic import write_bytes
from recon.report.epipolar_figures import (
    EpipolarPicture,
    epipolar_figure,
    level_lines,
    spread_points,
)
from recon.rig.rectification import RectifyRun
from recon.run.directory import RunDirectory


def present_rectify(run: RectifyRun, directory: RunDirectory) -> None:
    """Write ``pictures/epipolar_raw.png`` and ``pictures/epipolar_rectified.png``.

    Raises:
        OutputError: A file cannot be written.
    """
    chosen = spread_points(run.raw_px[0], 12)
    raw = [
        EpipolarPicture(image, pixels[chosen], [lines[n] for n in chosen], f"{side}, as recorded")
        for side, image, pixels, lines in zip(
            ("Left", "Right"),
            (run.pair.left, run.pair.right),
            run.raw_px,
            run.raw_lines,
            strict=True,
        )
    ]
    rows = level_lines(run.rectified_px[0][chosen], run.rectified[0].shape[1])
    level = [
        EpipolarPicture(image, pixels[chosen], rows, title)
        for title, image, pixels in zip(
            ("Left, rectified", "Right, rectified: rows of the left"),
            run.rectified,
            run.rectified_px,
            strict=True,
        )
    ]
    write_bytes(directory.path("pictures/epipolar_raw.png"), epipolar_figure(*raw))
    write_bytes(directory.path("pictures/epipolar_rectified.png"), epipolar_figure(*level))

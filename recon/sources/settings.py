"""What a user may have to say about a source that its files do not tell."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from recon.settings import Settings


class SourceSettings(Settings):
    """How pairs are found in a source. What a layout defines itself is not asked here."""

    left: str | None = Field(
        default=None,
        description="The left camera: a folder in the source, or a topic. none = found by name.",
    )
    right: str | None = Field(
        default=None,
        description="The right camera: a folder, or a topic; where the source is a left folder or "
        "a left video, the path of the right one. none = found by name.",
    )
    calibration: str | None = Field(
        default=None,
        description="Calibration file, in place of the one that the source has. none = its own.",
    )
    metres_per_unit: float = Field(
        default=1.0,
        gt=0,
        description="Unit of the translation in an OpenCV calibration file: 0.001 for mm.",
    )
    pair_by: Literal["auto", "stamp", "name", "index"] = Field(
        default="auto",
        description="How pictures of plain folders are paired. auto = by time stamps where there "
        "are any, else by equal names, else by their order where there are as many of each.",
    )
    tolerance_s: float = Field(
        default=0.01,
        gt=0,
        description="Largest difference between the stamps of a pair; others have no partner.",
    )
    rate_hz: float | None = Field(
        default=None,
        gt=0,
        description="Frames per second of a source without times. none = 10 for pictures, and "
        "what the file says for videos.",
    )
    side_by_side: Literal["left-right", "right-left", "top-bottom", "bottom-top"] = Field(
        default="left-right", description="Where the two views are in the frames of one video."
    )

"""The option that says where a drive begins in a map."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import typer

from recon.cli.options import parse_numbers
from recon.core.errors import SettingsError

if TYPE_CHECKING:
    from recon.map.localize.sequence import StartPose

StartInMap = Annotated[
    str | None,
    typer.Option(
        "--start",
        metavar="X,Y,YAW|FRAME",
        help="Where the drive begins in map axes, if known: metres, and degrees from x to y. "
        "A single number is the first frame to use.",
        show_default="anywhere in the map, frame 0",
    ),
]


def read_start(text: str | None) -> tuple[StartPose | None, int | None]:
    """Read where a drive begins: a pose ``x,y,yaw``, or the number of its first frame.

    Raises:
        SettingsError: It is neither.
    """
    numbers = parse_numbers(text, "--start") or ()
    if not numbers:
        return None, None
    if len(numbers) == 3 and all(map(math.isfinite, numbers)):
        from recon.map.localize.sequence import StartPose

        return StartPose(*numbers), None
    if len(numbers) == 1 and numbers[0].is_integer():
        return None, int(numbers[0])
    raise SettingsError(
        "not a pose, nor the number of a frame",
        where="--start",
        got=text,
        expected="x,y,yaw in metres and degrees, such as 12.5,-3,90; or one whole number",
    )

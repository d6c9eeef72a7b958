"""Calibration boards in the files of kalibr and basalt: target.yaml and aprilgrid.json."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from recon.core.errors import FormatError
from recon.core.values.board import CalibrationBoard, parse_board
from recon.io.fields import Fields, read_yaml
from recon.io.files import reading

_SUFFIXES: Final = frozenset({".yaml", ".yml", ".json"})
# Kind of board, columns, rows, and length of each type of target; the first has no type in basalt.
_TARGETS: Final = {
    "aprilgrid": ("aprilgrid", "tagCols", "tagRows", "tagSize"),
    "checkerboard": ("chess", "targetCols", "targetRows", "colSpacingMeters"),
    "circlegrid": ("circles", "targetCols", "targetRows", "spacingMeters"),
}


def read_board(text: str) -> CalibrationBoard:
    """Return the board that a text describes, or a file of kalibr; see `parse_board`.

    Raises:
        FormatError: The file has no board, or one that is not supported.
        SettingsError: The text describes none.
    """
    path = Path(text)
    if path.suffix.lower() not in _SUFFIXES:
        return parse_board(text)
    with reading(path):
        fields = Fields(read_yaml(path))
        kind = fields.text("target_type") if "target_type" in fields else "aprilgrid"
        if kind not in _TARGETS:
            raise FormatError("unknown target_type", got=kind, expected=", ".join(_TARGETS))
        name, *keys, length = _TARGETS[kind]
        columns, rows = map(fields.count, keys)
        own = [f"{fields.number(length):.12f}m"]
        if kind == "aprilgrid":
            own.append(f"{fields.number('tagSpacing'):.12f}")
        elif kind == "checkerboard" and fields.number("rowSpacingMeters") != fields.number(length):
            raise FormatError("squares of the board are not square")
        elif "asymmetricGrid" in fields and fields.text("asymmetricGrid").lower() in ("true", "1"):
            name = "acircles"
        return parse_board(":".join([name, f"{columns}x{rows}", *own]))

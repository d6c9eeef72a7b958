"""TOML files: lists of jobs, the list of data sets."""

from __future__ import annotations

import sys
from typing import Any

from recon.core.errors import FormatError
from recon.io.files import SMALL_FILE_BYTES, StrPath, read_text, reading

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def read_toml(path: StrPath) -> dict[str, Any]:
    """Read a TOML file."""
    text = read_text(path, SMALL_FILE_BYTES)
    with reading(path):
        try:
            return dict(tomllib.loads(text))
        except tomllib.TOMLDecodeError as error:
            raise FormatError("not a TOML file", where=path, got=error) from error

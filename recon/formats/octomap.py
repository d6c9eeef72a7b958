"""OctoMap files: ``.ot`` with log-odds, ``.bt`` with occupied and free alone."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from recon.adapters.pyoctomap import decode_octomap, encode_octomap
from recon.formats.atomic import write_bytes
from recon.structures import OccupancyVoxels


def write_octomap(path: str | PathLike[str], voxels: OccupancyVoxels) -> tuple[Path, Path]:
    """Write ``path.bt`` and ``path.ot``, each atomically.

    Args:
        path: Both names without their suffixes, such as ``map/octomap``.
        voxels: The map.

    Returns:
        The two paths written: ``.bt``, ``.ot``.

    Raises:
        MappingError: The map is larger than an OctoMap can be.
        OutputError: A file cannot be written.
    """
    stem = Path(path)
    binary, full = (stem.with_name(f"{stem.name}.{end}") for end in ("bt", "ot"))
    full_content, binary_content = encode_octomap(voxels.keys, voxels.log_odds, voxels.resolution_m)
    write_bytes(binary, binary_content)
    write_bytes(full, full_content)
    return binary, full


def read_octomap(path: str | PathLike[str]) -> OccupancyVoxels:
    """Read a ``.bt`` or ``.ot`` file; leaves that stand for many cells are expanded.

    The log-odds of a ``.bt`` file are those that OctoMap gives to occupied and to free.

    Raises:
        FormatError: The file is missing or is no OctoMap.
    """
    keys, log_odds, resolution_m = decode_octomap(Path(path))
    return OccupancyVoxels(keys, log_odds, resolution_m)

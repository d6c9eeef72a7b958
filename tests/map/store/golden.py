"""How `format_2.recon` was made: two drives through a rendered street, the second one linked.

``python -m tests.map.store.golden FILE`` makes another one with the code as it is. The committed
file was written by recon 1.0.0, and stays: whatever comes later within a major version reads it.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from recon.commands.config import load_config
from recon.map.drive.drive import Workspace
from recon.map.drive.sequence import map_sequence
from recon.map.map import Map
from recon.map.sessions.copying import keep_map
from recon.street.settings import StreetScene
from tests.scenery.film import RIG, Film, film

STREET = StreetScene(frames=6, **{**RIG, "width_px": 304, "height_px": 114, "focal_px": 171.0})
FIRST, SECOND = slice(0, 6), slice(1, 6, 2)
CONFIG = load_config(
    None,
    ["fusion.voxel_m=0.6", "fusion.min_count=2", "occupancy.resolution_m=2", "submaps.length_m=3"],
)


def brighter(image: np.ndarray) -> np.ndarray:
    return np.clip(image.astype(int) + 3, 0, 255).astype(np.uint8)


def write_golden(path: Path) -> None:
    street = film(STREET)
    with tempfile.TemporaryDirectory() as folder:
        second = Path(folder) / "second.recon"
        _map_drive(street.taken(FIRST), path)
        _map_drive(street.taken(SECOND, brighter), second)
        with Map.open(path, read_only=False) as map_, Map.open(second) as other:
            map_.merge(other)
            map_.commit()


def _map_drive(drive: Film, path: Path) -> None:
    with Map.temporary() as made:
        map_sequence(drive, CONFIG, workspace=Workspace(made))
        keep_map(made, path)


if __name__ == "__main__":
    write_golden(Path(sys.argv[1]))

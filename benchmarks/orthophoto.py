"""How near to their true places an orthophoto has things, by patches that are matched.

That of a run of `recon demo` is compared with its street rendered from 5 km above: the shift of
each patch of 64 cells for which the match is best, by phase correlation.

Example: python benchmarks/orthophoto.py outputs/demo/latest
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray

from recon.commands.config import run_settings
from recon.commands.export import run_export
from recon.core.geometry.se3 import apply, invert
from recon.core.values.arrays import Float64
from recon.sources.synthetic import SyntheticSource
from recon.street.materials import GAMMA
from recon.street.settings import StreetSettings

PATCH_PX: Final = 64
LEAST_RESPONSE: Final = 0.1  # of a match; a patch of even asphalt has none
FROM_M: Final = 5000.0  # so high that a roof is seen a centimetre aside


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        run_export(given.run, products=("orthophoto",), out=out)
        found = against_street(given.run, out / "map/orthophoto.tif")
    print(json.dumps(found) if given.json else found)


def against_street(run: Path, picture: Path) -> dict[str, Any]:
    """Compare the orthophoto of a run of a rendered street with the street from above."""
    street = StreetSettings.model_validate(dict(run_settings(run).street))
    summary = json.loads((run / "summary.json").read_text())
    source = SyntheticSource(street)
    T_street_map = invert(np.array(summary["T_map_world"]) @ source.world.T_world_street)
    with rasterio.open(picture) as file:
        ours, cell_m, (west, north) = file.read(), file.res[0], (file.bounds.left, file.bounds.top)
    row, column = np.indices(ours.shape[1:])
    level = -source.settings.camera_height_m
    xyz = np.stack([west + (column + 0.5) * cell_m, north - (row + 0.5) * cell_m], axis=-1)
    xyz = np.pad(xyz.reshape(-1, 2), ((0, 0), (0, 1)), constant_values=level)
    eye = np.append(xyz[:, :2].mean(axis=0), FROM_M)
    rays = (xyz - eye) @ T_street_map[:3, :3].T / (FROM_M - level)
    seen = source.camera.stage.look(apply(T_street_map, eye[None])[0], rays, cell_m / FROM_M)
    true = 255 * seen.rgb.reshape(*row.shape, 3) ** (1 / GAMMA)
    return shifts(ours[:3].mean(axis=0), true.mean(axis=2), ours[3] > 0, cell_m)


def shifts(one: Float64, other: Float64, known: NDArray[np.bool_], cell_m: float) -> dict[str, Any]:
    """Return by how much patches of two pictures lie apart, in metres and cells."""
    window = cv2.createHanningWindow((PATCH_PX, PATCH_PX), cv2.CV_64F)
    found = []
    for row in range(0, one.shape[0] - PATCH_PX, PATCH_PX // 2):
        for column in range(0, one.shape[1] - PATCH_PX, PATCH_PX // 2):
            at = np.s_[row : row + PATCH_PX, column : column + PATCH_PX]
            if known[at].mean() < 1:
                continue
            ours, theirs = (
                np.ascontiguousarray(each[at] - each[at].mean()) for each in (one, other)
            )
            shift, response = cv2.phaseCorrelate(ours, theirs, window)
            if response > LEAST_RESPONSE:
                found.append(shift)
    off = np.hypot(*np.array(found).T)
    return {
        "cell_m": cell_m,
        "patches": len(off),
        "median_cells": float(np.median(off)),
        "p95_cells": float(np.quantile(off, 0.95)),
        "median_m": float(np.median(off) * cell_m),
        "p95_m": float(np.quantile(off, 0.95) * cell_m),
        "mean_shift_m": (np.mean(found, axis=0) * cell_m).round(4).tolist(),
    }


if __name__ == "__main__":
    main()

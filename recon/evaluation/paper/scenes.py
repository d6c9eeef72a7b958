"""The seed paper's experiments 2 to 4: three scenes of the Middlebury benchmark at quarter size."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Final

from recon.core.errors import CalibrationError, SourceError
from recon.core.values import DisparityTruth, RectifiedCamera, StereoPair
from recon.io.middlebury.calib import read_middlebury_calib
from recon.io.middlebury.scene import read_middlebury_scene

#: Number of the experiment -> scene. Identified by Table 1, see docs/paper.md.
EXPERIMENTS: Final = MappingProxyType({2: "ArtL", 3: "Jadeplant", 4: "Pipes"})
_INSIDE_DATA: Final = Path("middlebury", "MiddEval3", "trainingQ")


@dataclass(frozen=True, eq=False)
class Experiment:
    """Input of one experiment.

    Attributes:
        number: Number of the experiment in the paper.
        scene: Name of the scene.
        pair: The colour images.
        camera: Geometry from the scene's ``calib.txt``.
        truth: True disparity of the left view, or None.
        doffs_px: Difference of the principal points; Table 1 prints it as the focal length.
        files: Files that the experiment was read from.
    """

    number: int
    scene: str
    pair: StereoPair
    camera: RectifiedCamera
    truth: DisparityTruth | None
    doffs_px: float
    files: tuple[Path, ...]

    @property
    def title(self) -> str:
        """Number and scene, for display."""
        return f"Experiment {self.number}: {self.scene}"

    @property
    def folder(self) -> str:
        """Name of its folder in the result folder."""
        return f"experiment_{self.number}_{self.scene}"


def default_scenes_folder() -> Path:
    """Return MiddEval3's quarter-size training scenes in ``RECON_DATA``.

    Raises:
        SourceError: The environment variable is not set.
    """
    data = os.environ.get("RECON_DATA")
    if not data:
        raise SourceError(
            "no folder of scenes is given, and RECON_DATA is not set",
            expected=f"a folder with {', '.join(EXPERIMENTS.values())}",
            hint="name the folder MiddEval3/trainingQ of the Middlebury benchmark",
        )
    return Path(data) / _INSIDE_DATA


def read_experiments(folder: Path) -> list[Experiment]:
    """Read the three scenes.

    Raises:
        SourceError: A scene is missing.
        FormatError: A file of a scene is damaged.
        CalibrationError: A scene's geometry cannot give depth.
    """
    missing = [scene for scene in EXPERIMENTS.values() if not (folder / scene).is_dir()]
    if missing:
        raise SourceError(
            "scenes of the paper are missing",
            where=folder,
            got=f"no folder {', '.join(missing)}",
            hint="name the folder MiddEval3/trainingQ of the Middlebury benchmark",
        )
    return [_read_experiment(number, folder / scene) for number, scene in EXPERIMENTS.items()]


def camera_of_table_1(camera: RectifiedCamera) -> RectifiedCamera:
    """Return the camera of Table 1: ``doffs`` taken as the focal length, and no offset added to d.

    Raises:
        CalibrationError: ``doffs`` is not positive, so it cannot be used as a focal length.
    """
    if camera.doffs_px <= 0:
        raise CalibrationError(
            "doffs cannot be used as a focal length",
            got=f"{camera.doffs_px:g} px",
            expected="> 0 px",
        )
    return replace(camera, focal_px=camera.doffs_px, cx_right_px=camera.cx_px)


def _read_experiment(number: int, folder: Path) -> Experiment:
    scene, calib = read_middlebury_scene(folder), read_middlebury_calib(folder / "calib.txt")
    camera = calib.camera
    doffs_px = camera.doffs_px if calib.doffs_px is None else calib.doffs_px
    return Experiment(
        number=number,
        scene=scene.name,
        pair=scene.pair,
        # The file rounds doffs and the principal points independently; doffs defines depth.
        camera=replace(camera, cx_right_px=camera.cx_px + doffs_px),
        truth=scene.truth,
        doffs_px=doffs_px,
        files=tuple(sorted(path for path in folder.iterdir() if path.is_file())),
    )

"""A Middlebury scene as a source of one pair."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from recon.core.errors import CalibrationError
from recon.core.values import RectifiedCamera, SequenceTruth, StereoPair
from recon.io.files import StrPath
from recon.io.middlebury.scene import MiddleburyScene, read_middlebury_scene


class MiddleburySource:
    """One pair with a published calibration.

    Args:
        folder: A scene of 2005 or 2006 (with ``dmin.txt``), 2014 or MiddEval3.

    Attributes:
        scene: All data of the folder, including the true disparity.

    Raises:
        FormatError: The folder is not a Middlebury scene, or a file in it is damaged.
        CalibrationError: No calibration is published for the scene, or it cannot give depth.
    """

    def __init__(self, folder: StrPath) -> None:
        self.scene: MiddleburyScene = read_middlebury_scene(folder)
        if self.scene.camera is None:
            raise CalibrationError(
                "no calibration is published for this scene, so there is no depth",
                where=folder,
                expected="calib.txt, or dmin.txt for scenes of 2005 and 2006",
            )
        self._camera = self.scene.camera
        self._folder = Path(folder)

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.scene.name

    @property
    def description(self) -> str:
        """One line."""
        return "a Middlebury scene: one rectified pair"

    @property
    def calibration(self) -> RectifiedCamera:
        """The rectified camera."""
        return self._camera

    @property
    def truth(self) -> SequenceTruth | None:
        """None: the ground truth is a disparity, see ``scene``."""
        return None

    @property
    def files(self) -> Sequence[Path]:
        """All files of the scene."""
        return sorted(path for path in self._folder.iterdir() if path.is_file())

    def __len__(self) -> int:
        return 1

    def __iter__(self) -> Iterator[StereoPair]:
        return self.frames()

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Yield the pair, or nothing from any later start."""
        yield from (self.scene.pair,)[start:]

"""Results of other programs on Middlebury scenes: folders with a PFM file for each scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from recon.core.errors import FormatError, SettingsError, SourceError
from recon.evaluation.middlebury.bench import SceneResult
from recon.evaluation.middlebury.scenes import ScoredScene, check_folder
from recon.evaluation.middlebury.score import score_result
from recon.io.files import naming, read_table
from recon.io.images.pfm import read_pfm
from recon.io.middlebury.layout import find_image, scene_root

_DISPARITY: Final = "disp0"
_TIME: Final = "time"
_SPARSE: Final = "_s"


@dataclass(frozen=True)
class ResultFolder:
    """The results of one method.

    Attributes:
        name: Last part of the folder's path, with parents if several share it.
        folder: The folder.
        files: The disparity map of each scene that has one, by scene name.
    """

    name: str
    folder: Path
    files: Mapping[str, Path]

    def read(self, scene: ScoredScene) -> SceneResult | None:
        """Read and score the result for a scene; None if there is none.

        Raises:
            FormatError: A file is damaged.
            EvaluationError: The size of the result is not that of the truth, nor 2 or 4 times
                larger or smaller.
        """
        file = self.files.get(scene.name)
        if file is None:
            return None
        values = read_pfm(file)
        with naming(file):
            figures = {**score_result(scene, values), "ndisp": None, "confidence": None}
        return SceneResult(scene, self.name, values, figures, _seconds(file), file)


def find_results(
    folders: Sequence[Path], scenes: Mapping[str, Path], taken: Sequence[str]
) -> list[ResultFolder]:
    """Find the results of methods for scenes.

    A scene's result is ``Teddy.pfm``, or the only ``disp0*.pfm`` in a folder ``Teddy``, as the
    benchmark's kit names them; the scene's name may be preceded by that of its folder
    (``trainingQ/Teddy``).

    Args:
        folders: One folder for each method.
        scenes: Folders of the scenes, by name.
        taken: Names that no method may have.

    Raises:
        SourceError: A folder is missing or has no result, or several for one scene.
        SettingsError: A folder is given twice.
    """
    found = []
    for name, folder in zip(_names(folders, taken), folders, strict=True):
        check_folder(folder)
        files = {scene: _file_of(folder, scene, path) for scene, path in scenes.items()}
        present = {scene: file for scene, file in files.items() if file is not None}
        if not present:
            first = next(iter(scenes))
            raise SourceError(
                "folder has no result for any scene",
                where=folder,
                expected=f"{first}.pfm, or {first}/{_DISPARITY}*.pfm, and so on",
            )
        found.append(ResultFolder(name, folder, present))
    return found


def _names(folders: Sequence[Path], taken: Sequence[str]) -> list[str]:
    """Return the shortest ends of the paths that distinguish them."""
    paths = [folder.resolve() for folder in folders]
    if len(set(paths)) < len(paths):
        raise SettingsError("a folder of results is given twice", got=", ".join(map(str, folders)))
    for depth in range(1, max((len(path.parts) for path in paths), default=0)):
        names = ["/".join(path.parts[-depth:]) for path in paths]
        if len({*names, *taken}) == len(names) + len(taken):
            return names
    return [str(path) for path in paths]


def _file_of(folder: Path, scene: str, path: Path) -> Path | None:
    root = scene_root(path)
    for name in dict.fromkeys((scene, f"{root.parent.name}/{root.name}", root.name)):
        file = folder / f"{name}.pfm"
        found = file if file.is_file() else _submitted(folder / name)
        if found is not None:
            return found
    return None


def _submitted(folder: Path) -> Path | None:
    """Return the dense result in the folder of one scene; not its ground truth."""
    truth = {"disp0GT.pfm"} if find_image(folder, "im0") is None else {"disp0GT.pfm", "disp0.pfm"}
    files = {file.stem: file for file in folder.glob(f"{_DISPARITY}*.pfm")}
    found = [
        file
        for stem, file in sorted(files.items())
        if file.name not in truth
        and not (stem.endswith(_SPARSE) and stem.removesuffix(_SPARSE) in files)
    ]
    if len(found) > 1:
        raise SourceError(
            "folder has several results for one scene",
            where=folder,
            got=", ".join(file.name for file in found),
            hint="keep each method in a folder of its own",
        )
    return found[0] if found else None


def _seconds(file: Path) -> float | None:
    """Return what ``timeX.txt`` beside ``disp0X.pfm`` says, if there is one."""
    beside = file.with_name(f"{_TIME}{file.stem.removeprefix(_DISPARITY)}.txt")
    if not file.stem.startswith(_DISPARITY) or not beside.is_file():
        return None
    table, _ = read_table(beside, (1,))
    seconds = float(table[0, 0])
    if not 0 <= seconds < float("inf"):
        raise FormatError("not a time in seconds", where=beside, got=f"{seconds:g}")
    return seconds

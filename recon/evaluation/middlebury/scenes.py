"""What is compared: the scenes of a folder with their truth, and results of other programs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import FormatError, SettingsError, SourceError
from recon.core.values import DisparityTruth, RectifiedCamera
from recon.evaluation.middlebury.score import MiddleburyRules, ScoredScene
from recon.io.files import read_table, resolved
from recon.io.middlebury import (
    MiddleburyScene,
    find_image,
    find_layout,
    read_middlebury_scene,
    scene_root,
    stand_in_camera,
)

_STEP: Final = 16
_DISPARITY: Final = "disp0"
_SPARSE: Final = "_s"


@dataclass(frozen=True)
class ResultFolder:
    """The results of one program: the disparity map of each scene that has one, by its name.

    The name is the last part of the folder's path, with parents if several share it.
    """

    name: str
    folder: Path
    files: Mapping[str, Path]


def check_folder(folder: Path) -> None:
    """Check that a path is an existing folder."""
    if not folder.is_dir():
        what = "not a folder" if folder.exists() else "folder does not exist"
        raise SourceError(what, where=folder)


def find_scenes(folder: Path) -> dict[str, Path]:
    """Return folders of all scenes at or below a folder, by scene name."""
    check_folder(folder)
    paths = sorted(_scenes_below(folder))
    if not paths:
        raise SourceError(
            "folder contains no Middlebury scene",
            where=folder,
            expected="folders with im0 and im1 and calib.txt, view1 and view5, or im2 and im6",
        )
    roots = [resolved(path) for path in paths]
    short = [path.relative_to(scene_root(path).parent).as_posix() for path in roots]
    if len(set(short)) < len(short):
        short = [path.relative_to(folder).as_posix() for path in paths]
    return dict(zip(short, paths, strict=True))


def _scenes_below(folder: Path) -> Iterator[Path]:
    """Find scenes recursively; they do not nest, so the search stops at each scene."""
    if find_layout(folder) is not None:
        yield folder
        return
    for path in folder.iterdir():
        if path.is_dir() and not path.name.startswith("."):
            yield from _scenes_below(path)


def read_scored_scene(name: str, path: Path, truth: Path | None) -> ScoredScene | None:
    """Read a scene with its ground truth; None if there is none for it.

    A scene without its own gets that of the folder ``truth``, possibly at another size: it holds
    a scene of the same name, or is that scene.
    """
    scene = read_middlebury_scene(path)
    judge = scene if scene.truth is not None else _judge(name, truth)
    if judge is None or judge.truth is None:
        return None
    width_px, truth_width_px = scene.pair.left.shape[1], judge.truth.values.shape[1]
    # Sizes may be off by a row or column; real mismatches are rejected by the comparison.
    factor = max(round(4 * truth_width_px / width_px), 1) / 4
    largest_px = None if scene.ndisp is None else scene.ndisp * factor
    rules = MiddleburyRules(judge.full_size_factor, largest_px, judge.isint)
    camera = _matching_camera(scene, judge.truth, factor)
    return ScoredScene(name, scene.pair, camera, judge.truth, judge.camera, rules)


def _judge(name: str, folder: Path | None) -> MiddleburyScene | None:
    """Return the scene with the truth for another."""
    last = name.rpartition("/")[2]
    for path in (folder / name, folder / last, folder) if folder else ():
        if path.name == last and path.is_dir() and find_layout(path) is not None:
            return read_middlebury_scene(path)
    return None


def _matching_camera(
    scene: MiddleburyScene, truth: DisparityTruth, factor: float
) -> RectifiedCamera:
    """Return the camera with a disparity range; if none is published, that of the ground truth.

    Scenes before 2014 are thus matched with the same prior knowledge as later ones.
    """
    height_px, width_px = scene.pair.left.shape[:2]
    camera = scene.camera or stand_in_camera(width_px, height_px)
    ndisp = scene.ndisp or camera.ndisp
    if ndisp is None:
        largest_px = float(np.nanmax(truth.values, initial=0.0)) / factor
        ndisp = _STEP * int(largest_px // _STEP + 1)
    return replace(camera, ndisp=ndisp)


def find_results(
    folders: Sequence[Path], scenes: Mapping[str, Path], taken: Sequence[str]
) -> list[ResultFolder]:
    """Find the results of other programs for scenes, one folder for each program.

    A scene's result is ``Teddy.pfm``, or the only ``disp0*.pfm`` in a folder ``Teddy``, as the
    benchmark's kit names them; the scene's name may be preceded by that of its folder
    (``trainingQ/Teddy``). No program gets a name that is ``taken``.
    """
    found = []
    for name, folder in zip(_names(folders, taken), folders, strict=True):
        check_folder(folder)
        files = {scene: _file_of(folder, scene, path) for scene, path in scenes.items()}
        present = {scene: file for scene, file in files.items() if file is not None}
        if not present:
            first = next(iter(scenes))
            expected = f"{first}.pfm, or {first}/{_DISPARITY}*.pfm, and so on"
            raise SourceError("folder has no result for any scene", where=folder, expected=expected)
        found.append(ResultFolder(name, folder, present))
    return found


def _names(folders: Sequence[Path], taken: Sequence[str]) -> list[str]:
    """Return the shortest ends of the paths that distinguish them."""
    paths = [resolved(folder) for folder in folders]
    if len(set(paths)) < len(paths):
        raise SettingsError("a folder of results is given twice", got=", ".join(map(str, folders)))
    for depth in range(1, max((len(path.parts) for path in paths), default=0)):
        names = ["/".join(path.parts[-depth:]) for path in paths]
        if len({*names, *taken}) == len(names) + len(taken):
            return names
    return [str(path) for path in paths]


def _file_of(folder: Path, scene: str, path: Path) -> Path | None:
    root = scene_root(path)
    for name in (scene, f"{root.parent.name}/{root.name}", root.name):
        file = folder / f"{name}.pfm"
        found = file if file.is_file() else _submitted(folder / name)
        if found is not None:
            return found
    return None


def _submitted(folder: Path) -> Path | None:
    """Return the dense result in the folder of one scene; not its ground truth."""
    truth = {"disp0GT", "disp0"} if find_image(folder, "im0") else {"disp0GT"}
    stems = {file.stem for file in folder.glob(f"{_DISPARITY}*.pfm")}
    sparse = {f"{stem}{_SPARSE}" for stem in stems}
    found = [f"{stem}.pfm" for stem in sorted(stems - truth - sparse)]
    if len(found) > 1:
        raise SourceError(
            "folder has several results for one scene",
            where=folder,
            got=", ".join(found),
            hint="keep each method in a folder of its own",
        )
    return folder / found[0] if found else None


def read_seconds(file: Path) -> float | None:
    """Return what ``timeX.txt`` beside a result ``disp0X.pfm`` says; None if there is none."""
    beside = file.with_name(f"time{file.stem.removeprefix(_DISPARITY)}.txt")
    if not file.stem.startswith(_DISPARITY) or not beside.is_file():
        return None
    seconds = float(read_table(beside, (1,))[0][0, 0])
    if not 0 <= seconds < float("inf"):
        raise FormatError("not a time in seconds", where=beside, got=f"{seconds:g}")
    return seconds

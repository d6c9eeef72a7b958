"""Middlebury scenes of a folder, each with the truth that results for it are scored against."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from recon.errors import SourceError
from recon.evaluation import MiddleburyRules
from recon.formats.middlebury import MiddleburyScene, read_middlebury_scene, stand_in_camera
from recon.formats.middlebury_layout import find_layout, scene_root
from recon.structures import DisparityTruth, RectifiedCamera, StereoPair

_STEP: Final = 16


@dataclass(frozen=True, eq=False)
class ScoredScene:
    """One scene, ready to be matched and scored.

    Attributes:
        name: Name of its folder; with the folders above it where several scenes share a name.
        pair: The pictures.
        camera: For matching; its ``ndisp`` is set.
        truth: True disparity, of the size of the pictures or of another.
        truth_camera: The camera at the size of the truth, or None where none is published.
        rules: How results are counted.
    """

    name: str
    pair: StereoPair
    camera: RectifiedCamera
    truth: DisparityTruth
    truth_camera: RectifiedCamera | None
    rules: MiddleburyRules


def find_scenes(folder: Path) -> dict[str, Path]:
    """The folders of all scenes in a folder or below it, or the folder itself, by name.

    Raises:
        SourceError: The folder is missing, or there is no scene in it.
    """
    check_folder(folder)
    paths = sorted(_scenes_below(folder))
    if not paths:
        raise SourceError(
            "folder contains no Middlebury scene",
            where=folder,
            expected="folders with im0 and im1 and calib.txt, view1 and view5, or im2 and im6",
        )
    return dict(zip(_names(folder, paths), paths, strict=True))


def check_folder(folder: Path) -> None:
    """Refuse what is no folder.

    Raises:
        SourceError: It is none.
    """
    if not folder.is_dir():
        what = "not a folder" if folder.exists() else "folder does not exist"
        raise SourceError(what, where=folder)


def read_scored_scene(name: str, path: Path, truth: Path | None) -> ScoredScene | None:
    """Read a scene with its truth.

    Args:
        name: What the scene is called.
        path: Its folder.
        truth: Folder of scenes whose truth is taken where the scene has none of its own, at
            another size perhaps: a scene of the same name, or that scene itself.

    Returns:
        The scene, or None where there is no truth for it.

    Raises:
        FormatError: A file is missing, damaged or of another size.
        CalibrationError: A calibration file cannot give depth.
    """
    scene = read_middlebury_scene(path)
    judge = scene if scene.truth is not None else _judge(name, truth)
    if judge is None or judge.truth is None:
        return None
    width_px, truth_width_px = scene.pair.left.shape[1], judge.truth.values.shape[1]
    # Sizes differ by a row or column; those that do not fit at all are refused when compared.
    factor = max(round(4 * truth_width_px / width_px), 1) / 4
    camera = _matching_camera(scene, judge.truth, factor)
    rules = MiddleburyRules(
        full_size_factor=judge.full_size_factor,
        largest_px=None if scene.ndisp is None else scene.ndisp * factor,
        isint=judge.isint,
    )
    return ScoredScene(name, scene.pair, camera, judge.truth, judge.camera, rules)


def _matching_camera(
    scene: MiddleburyScene, truth: DisparityTruth, factor: float
) -> RectifiedCamera:
    """The camera with a range; where none is published, the one that holds all of the truth.

    So the scenes before 2014 are matched with as much knowledge as the later ones, which publish
    a range, and all matchers with the same.
    """
    height_px, width_px = scene.pair.left.shape[:2]
    camera = scene.camera or stand_in_camera(width_px, height_px)
    ndisp = scene.ndisp or camera.ndisp
    if ndisp is None:
        largest_px = float(np.nanmax(truth.values, initial=0.0)) / factor
        ndisp = _STEP * int(largest_px // _STEP + 1)
    return replace(camera, ndisp=ndisp)


def _judge(name: str, folder: Path | None) -> MiddleburyScene | None:
    if folder is None:
        return None
    last = name.rpartition("/")[2]
    for path in (folder / name, folder / last, folder):
        if path.name == last and path.is_dir() and find_layout(path) is not None:
            return read_middlebury_scene(path)
    return None


def _scenes_below(folder: Path) -> Iterator[Path]:
    """Scenes lie in no scenes: below one there are only its own files."""
    if find_layout(folder) is not None:
        yield folder
        return
    for path in folder.iterdir():
        if path.is_dir() and not path.name.startswith("."):
            yield from _scenes_below(path)


def _short(path: Path) -> str:
    return path.relative_to(scene_root(path).parent).as_posix()


def _names(folder: Path, paths: Sequence[Path]) -> list[str]:
    short = [_short(path.resolve()) for path in paths]
    if len(set(short)) == len(short):
        return short
    return [path.relative_to(folder).as_posix() for path in paths]

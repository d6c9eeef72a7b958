"""Middlebury scenes of a folder, each with the ground truth it is scored against."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import SourceError
from recon.core.values import DisparityTruth, RectifiedCamera, StereoPair
from recon.evaluation.middlebury.rules import MiddleburyRules
from recon.io.middlebury.layout import find_layout, scene_root
from recon.io.middlebury.scene import MiddleburyScene, read_middlebury_scene, stand_in_camera

_STEP: Final = 16


@dataclass(frozen=True, eq=False)
class ScoredScene:
    """One scene, ready to be matched and scored.

    Attributes:
        name: Name of its folder, with parent folders if several scenes share a name.
        pair: The images.
        camera: The camera for matching; its ``ndisp`` is set.
        truth: True disparity, at the size of the images or another size.
        truth_camera: The camera at the size of the ground truth, or None if none is published.
        rules: The rules of scoring.
    """

    name: str
    pair: StereoPair
    camera: RectifiedCamera
    truth: DisparityTruth
    truth_camera: RectifiedCamera | None
    rules: MiddleburyRules


def find_scenes(folder: Path) -> dict[str, Path]:
    """Return folders of all scenes at or below a folder, by scene name.

    Raises:
        SourceError: The folder is missing or contains no scene.
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
    """Check that a path is an existing folder.

    Raises:
        SourceError: It is not.
    """
    if not folder.is_dir():
        what = "not a folder" if folder.exists() else "folder does not exist"
        raise SourceError(what, where=folder)


def read_scored_scene(name: str, path: Path, truth: Path | None) -> ScoredScene | None:
    """Read a scene with its ground truth.

    Args:
        name: Name of the scene.
        path: Its folder.
        truth: Folder that supplies ground truth, possibly at another size, if the scene has none
            of its own: it holds a scene of the same name, or is that scene.

    Returns:
        The scene, or None if there is no ground truth for it.

    Raises:
        FormatError: A file is missing, damaged or of the wrong size.
        CalibrationError: A calibration file cannot give depth.
    """
    scene = read_middlebury_scene(path)
    judge = scene if scene.truth is not None else _judge(name, truth)
    if judge is None or judge.truth is None:
        return None
    width_px, truth_width_px = scene.pair.left.shape[1], judge.truth.values.shape[1]
    # Sizes may be off by a row or column; real mismatches are rejected by the comparison.
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
    """Return the camera with a disparity range; if none is published, that of the ground truth.

    Scenes before 2014 are thus matched with the same prior knowledge as later ones, which publish
    a range, and the range is the same for all matchers.
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
    """Find scenes recursively; they do not nest, so the search stops at each scene."""
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

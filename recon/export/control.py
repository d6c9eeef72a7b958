"""A map placed by control points: what images show of them, against where they were surveyed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from recon.core.errors import EvaluationError
from recon.core.geometry.alignment import find_agreeing, fit_points, fit_upright
from recon.core.geometry.se3 import apply, exp_so3, invert, make_transform
from recon.core.progress import tracked
from recon.core.text import metres
from recon.core.values import Disparity, RectifiedCamera, StereoCalibration
from recon.core.values.arrays import Float64
from recon.core.values.camera import project, unproject
from recon.export.product import DriveImages, open_images
from recon.io.models.las import check_inside
from recon.io.positions import ControlPoint
from recon.map.map import Map
from recon.map.sessions.georeference import ControlFigures, Georeference, edge_m, georeference
from recon.map.sessions.measured import LEVEL_RAD, Survey, fixed_turn, span_m
from recon.map.sessions.placed import settings_of
from recon.stereo.frame import FrameReconstructor
from recon.stereo.rectify.rectifier import turns_of

_FEWEST: Final = 3
_CLICK_PX: Final = 1.0  # standard deviation of a pixel that a person has chosen
SURVEYED_M: Final = 0.02  # of a coordinate, by a receiver with corrections
_MOST_SIGMAS: Final = 3.0  # by which a coordinate may be off without a word
_NOWHERE: Final = (np.full(3, np.nan), np.eye(3))


class Sighting(NamedTuple):
    """What an image shows of a point."""

    T_camera_map: Float64
    camera: RectifiedCamera
    uvd: Float64  # (3,), rectified; the disparity NaN where there is none
    sigma_px: Float64  # (3,)


def locate(map_: Map, survey: Survey, images: Sequence[Path], threads: int | None) -> Georeference:
    """Place a map by what a survey measured: positions along its first drive, or control points.

    A control point is found in map axes by all that left images show of it, with their disparities,
    as uncertain as these are; then the map is turned and moved, rigid, by the points that agree.

    Raises:
        EvaluationError: Fewer than three points can be found in the map, an image is not there, or
            the points do not fix how the map is turned.
    """
    control, where = survey.control, survey.positions
    if control is None:
        return georeference(map_, survey)
    images_of, points = _Images(open_images(map_, images), where, threads), control.points
    ours = [
        triangulate([images_of.sighting(*seen) for seen in point.seen]) or _NOWHERE
        for point in tracked(points, "points", "match control points")
    ]
    ours_m, place_m = np.array([xyz for xyz, _ in ours]), np.array([p.place_m for p in points])
    # Check points are only compared: nothing up to the figures depends on them.
    used = np.isfinite(ours_m[:, 0]) & ~np.array([point.check for point in points])
    if used.sum() < _FEWEST:
        what, expected = "too few control points", f"{_FEWEST} with depth, besides check points"
        flat = [point.name for point, xyz in zip(points, ours_m, strict=True) if np.isnan(xyz[0])]
        hint = f"without depth where it is seen: {', '.join(flat[:5])}" if flat else ""
        raise EvaluationError(what, where=where, got=int(used.sum()), expected=expected, hint=hint)
    check_inside(control.system, np.median(place_m[used], axis=0), where)
    spread = np.array([covariance for _, covariance in ours]) + SURVEYED_M**2 * np.eye(3)
    sigma_m = np.sqrt(np.linalg.eigvalsh(spread[used])[:, -1])
    agree = used.copy()
    agree[used] = find_agreeing(ours_m[used], place_m[used], 4 * float(np.median(sigma_m)))
    T = _fitted(ours_m[agree], place_m[agree], spread[agree])
    there_m, sigma_m = apply(T, ours_m), sigma_m[agree[used]]
    off_m, freedom = there_m - place_m, max(1, 3 * int(agree.sum()) - 6)
    worse = np.sqrt(np.sum((off_m[agree] / sigma_m[:, None]) ** 2) / freedom)
    known_m = sigma_m * max(1.0, float(worse))
    turn = fixed_turn(there_m[agree], place_m[agree], known_m, where, "control points")
    placed = Georeference(
        T,
        control.system,
        off_m[agree],
        span_m(place_m[agree]),
        fit_points(ours_m[agree], place_m[agree], scaled=True).scale,
        int((used & ~agree).sum()),
        (),
        turn,
        edge_m(map_, T, turn, place_m[agree]),
        place_m[agree].mean(axis=0),
        float(np.sum(known_m**-2.0) ** -0.5),
    )
    checked = np.array([point.check for point in points])[:, None, None]
    expected_m2 = T[:3, :3] @ spread @ T[:3, :3].T + checked * placed.covariance(place_m)
    rows = zip(points, off_m, expected_m2, agree, strict=True)
    compared = {point.name: _compared(point, *row) for point, *row in rows}
    lines = (
        f"{'check' if one.check else 'control'} point {name} {one.note}"
        for name, one in compared.items()
        if one.note
    )
    return replace(placed, points=compared, lines=tuple(lines))


def _compared(
    point: ControlPoint, off_m: Float64, expected_m2: Float64, used: bool
) -> ControlFigures:
    """Return how far the map is off a point (3,), beside the covariance (3, 3) of that."""
    sigma_m = np.sqrt([*np.diag(expected_m2), np.linalg.eigvalsh(expected_m2)[-1]])
    sigma_m[np.isnan(off_m[0])] = np.nan
    apart, times = metres(float(np.linalg.norm(off_m))), np.max(np.abs(off_m) / sigma_m[:3])
    notes = {
        "has no depth where it is seen: left out": np.isnan(times),
        f"contradicts the others: {apart} off, left out": not (used or point.check),
        f"is {apart} off, {times:.1f} standard deviations in a coordinate": times > _MOST_SIGMAS,
    }
    note = next((text for text, holds in notes.items() if holds), "")
    (e, n, u), (sigma_e, sigma_n, sigma_u, worst) = off_m.tolist(), sigma_m.tolist()
    images = [image for image, _ in point.seen]
    state = images, bool(used), point.check, note
    return ControlFigures(e, n, u, sigma_e, sigma_n, sigma_u, worst, *state)


class _Images:
    """The left images of the drives of a map, matched once each."""

    def __init__(self, drives: Sequence[DriveImages], where: Path, threads: int | None) -> None:
        self._drives, self._where = drives, where
        self._matchers = [
            FrameReconstructor(one.rig, settings_of(one.session), threads=threads) for one in drives
        ]
        self._turns = [turns_of(one.rig, settings_of(one.session).rectification) for one in drives]
        self._matched: dict[tuple[int, int], Disparity] = {}

    def sighting(self, image: str, pixel: Float64) -> Sighting:
        number, frame = self._frame(image)
        drive = self._drives[number]
        at = pixel[None]
        if isinstance(drive.rig, StereoCalibration):
            at = self._turns[number].place(drive.rig, at)
        camera, (u, v) = drive.session.camera, at[0]
        if not (0 <= u <= camera.width_px - 1 and 0 <= v <= camera.height_px - 1):
            got, expected = f"{pixel[0]:g}, {pixel[1]:g}", f"within the rectified image {image}"
            raise EvaluationError("no such pixel", where=self._where, got=got, expected=expected)
        if (number, frame) not in self._matched:
            pair = next(drive.source.frames(frame))
            self._matched[number, frame] = self._matchers[number].match(pair)[1].only_measured()
        seen = self._matched[number, frame]
        return sighted(drive.T_map_camera[frame], camera, seen, float(u), float(v))

    def _frame(self, image: str) -> tuple[int, int]:
        """Return which drive has an image of that name or number, and which frame it is there.

        The folder before the name may be that of the drive, or its number in the map.
        """
        names = [(str(one.session.number), one.session.info.source) for one in self._drives]
        asked = [Path(image).parent.name in known for known in names]
        of = {
            n: frame
            for n, drive in enumerate(self._drives)
            if (frame := drive.source.number_of(image)) is not None
            and frame < len(drive.placed)
            and (asked[n] or not any(asked))
        }
        if len(of) == 1:
            [(number, frame)] = of.items()
            if self._drives[number].placed[frame]:
                return number, frame
            what = "the image has no place in the map"
            raise EvaluationError(what, where=self._where, got=image)
        what, expected = "no such image in the drive", "the name of a left image, or its number"
        if of:
            what = "several drives have this image"
            each = (f"{names[n][0]}/{image} of {names[n][1]}" for n in of)
            expected = f"the drive before it: {' or '.join(each)}"
        raise EvaluationError(what, where=self._where, got=image, expected=expected)


def sighted(
    T_map_camera: Float64, camera: RectifiedCamera, seen: Disparity, u: float, v: float
) -> Sighting:
    """Return what an image shows of a point at a rectified pixel that a person has chosen."""
    at = round(v), round(u)
    sigma_px = np.array([_CLICK_PX, _CLICK_PX, seen.sigma_px[at]], np.float64)
    uvd = np.array([u, v, seen.values[at]], np.float64)
    return Sighting(invert(T_map_camera), camera, uvd, sigma_px)


def triangulate(sightings: Sequence[Sighting]) -> tuple[Float64, Float64] | None:
    """Return a point (3,), map axes, by least squares, and its covariance; None without depth."""
    deep = [one for one in sightings if np.isfinite(one.uvd[2])]
    if not deep:
        return None

    def off(xyz: Float64) -> Float64:
        parts = []
        for one in sightings:
            shown = np.stack(project(apply(one.T_camera_map, xyz[None]), one.camera), axis=1)[0]
            parts.append(np.nan_to_num((shown - one.uvd) / one.sigma_px))
        return np.concatenate(parts)

    first = min(deep, key=lambda one: float(one.sigma_px[2] / one.uvd[2] ** 2))
    u, v, d = first.uvd[:, None]
    depth_m = first.camera.focal_px * first.camera.baseline_m / (d + first.camera.doffs_px)
    xyz = apply(invert(first.T_camera_map), unproject(u, v, depth_m, first.camera))[0]
    solved = least_squares(off, xyz)
    return solved.x, np.linalg.inv(solved.jac.T @ solved.jac)


def _fitted(ours_m: Float64, place_m: Float64, spread: Float64) -> Float64:
    """Return T_survey_map, nearly level, by points with covariances (N, 3, 3) in map axes."""
    start = fit_upright(ours_m, place_m).T_to_from
    middle_m = ours_m.mean(axis=0)

    def moved(step: Float64) -> Float64:
        turn = make_transform(exp_so3(step[:3]), apply(start, middle_m[None])[0] + step[3:])
        back = make_transform(start[:3, :3], -start[:3, :3] @ middle_m)
        return np.asarray(turn @ back)

    weights = np.linalg.inv(np.linalg.cholesky(start[:3, :3] @ spread @ start[:3, :3].T))

    def off(step: Float64) -> Float64:
        T = moved(step)
        apart = np.einsum("nij,nj->ni", weights, apply(T, ours_m) - place_m)
        return np.concatenate([apart.ravel(), T[:2, 2] / LEVEL_RAD])

    return moved(least_squares(off, np.zeros(6)).x)

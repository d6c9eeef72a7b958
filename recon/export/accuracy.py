"""How accurate a map in the coordinates of a survey is, and of which files that is said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Self

from recon.core.geometry.se3 import apply
from recon.core.kernels.voxels import pack_keys, unpack_keys
from recon.core.machine import versions
from recon.core.progress import tracked
from recon.core.summary import Figures
from recon.core.text import counted, metres
from recon.core.values.arrays import Float64
from recon.export.cloud import even_sample, ground_points
from recon.export.control import SURVEYED_M
from recon.export.occupancy import Flattening
from recon.export.product import ExportContext
from recon.io.files import digest_of
from recon.map.sessions.georeference import Georeference, SurveyFigures
from recon.map.store.session import Session

ENOUGH: Final = 30  # check points for a statement by ASPRS
_MOST_VOXELS: Final = 20_000  # of the ground, all over the map, that frames are asked for
_OFF = attrgetter("east_m", "north_m", "up_m")
Spread = Mapping[str, float]  # ``median``, ``p5`` and ``p95``, percentiles


@dataclass(frozen=True)
class ErrorFigures(Figures):
    """Map minus survey at some points, metres: means, and roots of mean squares."""

    points: int
    mean_m: Mapping[str, float]  # ``east``, ``north`` and ``up``
    rmse_m: Mapping[str, float]  # those, ``horizontal`` (both together) and ``3d``

    @classmethod
    def of(cls, off_m: ArrayLike, survey_m: float = 0.0) -> Self:
        """Return those of differences (N, 3), with the error of the survey in each coordinate.

        Ref: ASPRS Positional Accuracy Standards for Digital Geospatial Data, edition 2, 2023.
        """
        off, names = np.asarray(off_m, np.float64), ("east", "north", "up")
        square = np.mean(off**2, axis=0) + survey_m**2
        rmse_m = np.sqrt([*square, square[:2].sum(), square.sum()]).tolist()
        rmse = dict(zip((*names, "horizontal", "3d"), rmse_m, strict=True))
        return cls(len(off), dict(zip(names, off.mean(axis=0).tolist(), strict=True)), rmse)


@dataclass(frozen=True, kw_only=True)
class AccuracyFigures(Figures):
    """What ``accuracy.json`` has."""

    made_utc: str
    system: str | None  # the coordinate system; None = not known
    statement: str
    # Of ``check`` points, by which nothing is placed; ``tested``: of these with the error of their
    # survey, as ASPRS asks for; of ``control`` points or a ``path``, which place the map.
    errors: Mapping[str, ErrorFigures]
    surveyed_m: float  # standard deviation of a coordinate of a point, which is assumed
    survey: SurveyFigures
    spreads: Mapping[str, Spread]  # of what `measure_accuracy` says, as far as it is known
    drives: Sequence[Mapping[str, Any]]
    versions: Mapping[str, str]
    sha256: Mapping[str, Mapping[str, str]]  # of files by their names
    warnings: Sequence[str]


def measure_accuracy(
    context: ExportContext, placed: Georeference, files: Mapping[str, Mapping[str, Path]]
) -> tuple[AccuracyFigures, Float64]:
    """Measure how accurate a map is by its survey, and hash the files of which that is said.

    ``files`` are ``inputs`` and ``products``, by the names under which they are to be found.
    Spreads are of the standard deviation of a place of the cloud (all three coordinates together),
    and of what rays show of the ground: how wide a pixel is there in the best frame, how many
    frames saw it, and the fraction of what a keyframe saw that the next one saw, too.

    Returns:
        The figures; and places of the cloud, float64 (N, 4): east, north, up, standard deviation.
    """
    points, cloud = placed.points.values(), even_sample(context.placed.tiles)
    xyz = apply(placed.T_survey_map, cloud.xyz.astype(np.float64))
    own_m = np.nan if cloud.sigma_m is None else cloud.sigma_m
    sigma_m = np.sqrt(own_m**2 + np.trace(placed.covariance(xyz), axis1=1, axis2=2))
    off_m: dict[str, Sequence[Any]] = {
        "check": [_OFF(one) for one in points if one.check and np.isfinite(one.east_m)],
        "control": [_OFF(one) for one in points if one.used],
        "path": () if points else placed.off_m.tolist(),
    }
    errors = {name: ErrorFigures.of(some) for name, some in off_m.items() if some}
    if "check" in errors:
        errors["tested"] = ErrorFigures.of(off_m["check"], SURVEYED_M)
    values = {"sigma_m": sigma_m, **_seen_ground(context)}
    figures = AccuracyFigures(
        made_utc=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        system=placed.system,
        statement=_statement(errors.get("tested")),
        errors=errors,
        surveyed_m=SURVEYED_M,
        survey=placed.figures(),
        spreads={name: _spread(some) for name, some in values.items() if np.isfinite(some).any()},
        drives=[_drive(session, context) for session in context.map.linked],
        versions=versions(),
        sha256={
            kind: {name: digest_of(path) for name, path in tracked([*some.items()], "files")}
            for kind, some in files.items()
        },
        warnings=placed.warnings(),
    )
    return figures, np.column_stack([xyz, sigma_m])


def _statement(tested: ErrorFigures | None) -> str:
    if tested is None:
        return "No check points: nothing independent says how accurate the map is."
    points = counted(tested.points, "check point")
    if tested.points < ENOUGH:
        return f"{points}: too few for a statement by ASPRS ({ENOUGH})."
    flat, up = metres(tested.rmse_m["horizontal"]), metres(tested.rmse_m["up"])
    return f"Tested by {points} (ASPRS, edition 2, 2023): RMSE_H {flat}, RMSE_V {up}."


def _spread(values: Float64) -> Spread:
    found = np.quantile(values[np.isfinite(values)], (0.5, 0.05, 0.95))
    return dict(zip(("median", "p5", "p95"), found.tolist(), strict=True))


def _drive(session: Session, context: ExportContext) -> dict[str, Any]:
    date, rig, placed = session.date, session.rig, context.map.placed[session.number]
    return {
        "name": session.info.source, "date": date.text, "date_from": date.known_from,
        "frames": len(session), "frames_placed": int(placed.sum()),
        "keyframes": len(session.keyframes.frames), "path_m": session.trajectory.path_length_m,
        **asdict(session.camera),
        "rig_refined": rig is not None and rig.calibration is not rig.given,
        "recon": session.info.versions.get("recon", ""),
    }  # fmt: skip


def _seen_ground(context: ExportContext) -> dict[str, Float64]:
    """Return what rays show of the voxels of the ground; nothing if no rays were kept."""
    tiles, looks = context.placed.tiles, context.placed.tiles.observations
    found = [np.zeros((0, 3), np.int64)]
    for bounds, surface in Flattening(context.placed).grounds() if looks is not None else ():
        cloud = tiles.cloud_in(bounds)
        on = cloud.xyz[ground_points(cloud, surface)]
        found.append(np.floor(on / tiles.resolution_m).astype(np.int64))
    keys = np.unique(pack_keys(np.concatenate(found)))
    if looks is None or not len(keys):
        return {}
    keys = keys[:: -(-len(keys) // _MOST_VOXELS)]
    places_m = (unpack_keys(keys) + 0.5) * tiles.resolution_m
    focal_px = {one.number: one.camera.focal_px for one in context.map.linked}
    keyframes = {one.number: {*one.keyframes.frames} for one in context.map.linked}
    gsd_m, frames, overlaps = np.full(len(keys), np.nan), np.zeros(len(keys)), [np.nan]
    before = dict.fromkeys(keyframes, np.zeros(len(keys), np.bool_))
    for number, look in tracked(looks.by_frame(keys), "frames", "ground"):
        hit, (drive, frame) = look > 0, looks.frames[number]
        off_m = looks.T_map_camera[number][:3, 3] - places_m[hit]
        # Root of what a pixel covers of a level surface, as cells of the orthophoto are wide.
        away_m, above_m = np.linalg.norm(off_m, axis=1), np.maximum(off_m[:, 2], 1e-6)
        gsd_m[hit] = np.fmin(gsd_m[hit], np.sqrt(away_m**3 / above_m) / focal_px[drive])
        frames += hit
        if frame in keyframes[drive]:
            if before[drive].any():
                overlaps.append(float(hit[before[drive]].mean()))
            before[drive] = hit
    frames[frames == 0] = np.nan
    return {"gsd_m": gsd_m, "frames": frames, "keyframe_overlap": np.array(overlaps)}

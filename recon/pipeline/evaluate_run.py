"""`recon evaluate` without its command line: files in, figures out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from recon.errors import EvaluationError, FormatError
from recon.evaluation import evaluate_disparity, evaluate_map
from recon.formats.image import read_grey_levels
from recon.formats.pfm import read_pfm
from recon.formats.ply import read_ply
from recon.geometry.se3 import invert
from recon.geometry.transform import transform_cloud
from recon.pipeline.middlebury_confidence import curve_figures
from recon.pipeline.middlebury_score import dense_map, named_figures
from recon.pipeline.pair_input import read_disparity
from recon.pipeline.run_directory import RECORD
from recon.pipeline.summary import plain
from recon.structures import Disparity, DisparityTruth, PointCloud, Reason
from recon.structures.arrays import Float32, Float64

ReferenceFrame = Literal["camera", "map"]
_COUNTED: Final = 255


def compare_disparities(
    estimate: Path,
    truth: Path,
    mask: Path | None = None,
    *,
    scale: float = 1.0,
    confidence: Path | None = None,
) -> dict[str, Any]:
    """Figures of one disparity map file (PFM or 16-bit PNG) against another.

    Args:
        estimate: The map; holes are filled for the dense figures, KITTI's ``d1`` among them.
        truth: The true one, of the same size.
        mask: A picture that is 255 where pixels are compared; None = all with a truth.
        scale: Pixels of the size that figures are given in per pixel here.
        confidence: PFM of the map's confidence, in [0, 1]; a pixel is right when it is off by no
            more than a pixel of the map.

    Raises:
        FormatError: A file cannot be read.
        EvaluationError: The two cannot be compared.
    """
    values, true = read_disparity(estimate), read_disparity(truth)
    counted = np.isfinite(true) if mask is None else read_grey_levels(mask) == _COUNTED
    if counted.shape != true.shape:
        raise EvaluationError(
            "mask and truth differ in size", where=mask, got=counted.shape, expected=true.shape
        )
    known = DisparityTruth(true, counted)
    found = evaluate_disparity(values, known, scale=scale)
    figures: dict[str, Any] = {"pixels": found.pixels, "invalid": found.invalid}
    for name, metrics in (
        ("sparse", found),
        ("dense", evaluate_disparity(dense_map(values), known, scale=scale)),
    ):
        figures[name] = {**named_figures(metrics), "d1": metrics.d1}
    if confidence is not None:
        compared = np.where(counted, true, np.float32(np.nan))
        rated = _rated(values, confidence)
        figures["confidence"] = curve_figures(
            rated, DisparityTruth(compared, np.isfinite(compared)), limit_px=1.0
        )
    return dict(plain(figures))


def _rated(values: Float32, path: Path) -> Disparity:
    """A map with the confidence of a file."""
    confidence = read_pfm(path)
    if confidence.shape != values.shape:
        raise EvaluationError(
            "confidence and map differ in size",
            where=path,
            got=confidence.shape,
            expected=values.shape,
        )
    known = np.isfinite(values)
    if not ((confidence[known] >= 0) & (confidence[known] <= 1)).all():
        raise EvaluationError("confidence is not between 0 and 1", where=path)
    return Disparity(
        values=values,
        confidence=np.where(known, confidence, np.float32(0)),
        sigma_px=np.full(values.shape, np.nan, np.float32),
        reason=np.where(known, np.uint8(Reason.VALID), np.uint8(Reason.AMBIGUOUS)),
    )


def compare_maps(
    run: Path, reference: Path, *, frame: ReferenceFrame, threshold_m: float
) -> dict[str, Any]:
    """Figures of a map against a reference cloud.

    Args:
        run: A run's folder, or a PLY. A PLY inside a run's folder is in that run's map axes; any
            other PLY is taken to be in the axes of the reference already.
        reference: A PLY.
        frame: Axes of the reference: those of the first left camera, or the map's.
        threshold_m: Distance below which a point counts as right.

    Raises:
        FormatError: A file cannot be read, or the folder holds no finished run.
        EvaluationError: The two cannot be compared.
    """
    cloud, T_map_world = _read_cloud(run)
    if frame == "camera" and T_map_world is not None:
        cloud = transform_cloud(cloud, invert(T_map_world), frame="camera")
    truth = PointCloud(xyz=read_ply(reference).xyz, frame=cloud.frame)
    return dict(plain(evaluate_map(cloud, truth, threshold_m)))


def _read_cloud(run: Path) -> tuple[PointCloud, Float64 | None]:
    """The cloud, and T_map_world of the run that it belongs to, if any."""
    if run.is_dir():
        if not (run / RECORD).is_file():
            raise FormatError("folder holds no finished run", where=run, expected=f"a {RECORD}")
        return read_ply(run / "map" / "cloud.ply"), _read_axes(run / RECORD)
    record = run.parent.parent / RECORD
    inside = run.parent.name == "map" and record.is_file()
    return read_ply(run), _read_axes(record) if inside else None


def _read_axes(record: Path) -> Float64:
    """T_map_world as the run recorded it."""
    try:
        T_map_world = np.array(json.loads(record.read_text(encoding="utf-8"))["T_map_world"], float)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FormatError("record of the run has no T_map_world", where=record) from error
    if T_map_world.shape != (4, 4) or not np.isfinite(T_map_world).all():
        raise FormatError("T_map_world is no 4x4 matrix", where=record)
    return T_map_world

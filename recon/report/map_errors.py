"""Clouds coloured by their distance to each other."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from recon.core.values import PointCloud
from recon.evaluation.map import nearest_distances
from recon.evaluation.map_comparison import MapComparison
from recon.io.models.ply import write_ply
from recon.report.colour import ERROR_SCALE, colour_values
from recon.run.directory import RunDirectory

_SCALE_THRESHOLDS: Final = 2.0
"""The last colour of the scale corresponds to this multiple of the largest threshold."""


def write_map_errors(comparison: MapComparison, run: RunDirectory) -> None:
    """Write ``error.ply`` and ``missed.ply``, both in the axes of the reference.

    The first is the map, coloured by the distance of each point to the reference; the second is
    the reference, coloured by the distance to the map. ``quality`` is the distance in metres.
    """
    limit_m = _SCALE_THRESHOLDS * max(comparison.thresholds_m)
    cloud, reference = comparison.cloud, comparison.reference
    for name, points, others in (("error", cloud, reference), ("missed", reference, cloud)):
        distance_m = nearest_distances(points.xyz, others.xyz)
        rgb = colour_values(distance_m, ERROR_SCALE, (0.0, limit_m))
        coloured = replace(PointCloud(points.xyz, frame=points.frame), rgb=rgb)
        write_ply(run.path(f"{name}.ply"), coloured, quality=distance_m)

"""Refuses results without a single point, and says why there is none."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

import numpy as np

from recon.core.errors import MappingError
from recon.core.geometry.projection import depth_from_disparity
from recon.core.values import Disparity, RectifiedCamera
from recon.core.words import counted
from recon.map.drive.sequence import MappedSequence
from recon.map.fusion.builder import fusion_range_m
from recon.odometry.protocol import OdometryHealth
from recon.stereo.cloud.back_project import CloudSettings
from recon.stereo.frame import ReconstructedFrame


def check_cloud(frame: ReconstructedFrame, settings: CloudSettings, where: str) -> None:
    """Refuse a pair whose matches give no point."""
    if not len(frame.cloud):
        raise MappingError(
            "the cloud is empty",
            where=where,
            got=_depths(frame.disparity, frame.pair.camera),
            expected=f"points {_limits(settings)}",
            hint="check the unit of the baseline, or set cloud.max_range_m and "
            "cloud.max_relative_sigma",
        )


def check_map(mapped: MappedSequence, where: str, findings: Sequence[str] = ()) -> None:
    """Refuse a drive that gives no map.

    Args:
        mapped: The drive.
        where: Its name.
        findings: What an audit found, the worst first.
    """
    if any(len(tile.cloud) for tile in mapped.tiles):
        return
    why, hint = _explain_poses(mapped.health) or _explain_sample(mapped)
    hint = "; ".join((*findings[:1], hint))
    raise MappingError("the map is empty", where=where, got=why, hint=hint)


def _explain_poses(health: Sequence[OdometryHealth]) -> tuple[str, str] | None:
    """Return what is wrong with the poses, and what to do; None if most are trusted."""
    bad = [record for record in health if not record.ok]
    if 2 * len(bad) <= len(health):
        return None
    notes = [note for record in bad for note in record.notes]
    # Notes differ in their numbers.
    kinds = Counter(re.sub(r"\d+", "", note) for note in notes)
    most = next((n for n in notes if re.sub(r"\d+", "", n) == kinds.most_common(1)[0][0]), "")
    hint = "recon audit SOURCE shows what is wrong with the images"
    if "prior" in most:
        hint = (
            "check the prior: its axes (--set odometry.prior.axes=auto finds them), its unit "
            "(metres) and its clock"
        )
    return f"{len(bad)} of {counted(len(health), 'pose')} are not to be trusted ({most})", hint


def _explain_sample(mapped: MappedSequence) -> tuple[str, str]:
    """Return why nothing of the frame in the middle of the drive is in the map, and what to do."""
    config, frame = mapped.config, mapped.sample
    if not len(frame.cloud):
        found = _depths(frame.disparity, mapped.camera)
        return f"no point in the middle of the drive: {found}", (
            "recon audit SOURCE shows what is wrong; see cloud.max_range_m and "
            "cloud.max_relative_sigma"
        )
    nearest_m, reach_m = _nearest_m(frame), fusion_range_m(mapped.camera, config.fusion)
    if nearest_m > reach_m:
        got = f"the nearest point is {nearest_m:.1f} m away, the map ends at {reach_m:.1f} m"
        return got, "allow larger errors with --set fusion.max_depth_error_m="
    frames = len(mapped.trajectory)
    return f"of {counted(frames, 'frame')}, too few saw the same place", (
        "use recon pair for a single pair, or lower fusion.min_count"
    )


def _nearest_m(frame: ReconstructedFrame) -> float:
    return float(frame.cloud.xyz[:, 2].min())


def _depths(disparity: Disparity, camera: RectifiedCamera) -> str:
    """Return the share of pixels with a match, and their depths."""
    share = f"{100 * float(disparity.valid.mean()):.1f} % of the pixels matched"
    if not disparity.valid.any():
        return share
    depth_m = depth_from_disparity(disparity.values[disparity.valid], camera)
    low, high = np.nanpercentile(depth_m, [5, 95])
    return f"{share}, at {low:.3g} to {high:.3g} m"


def _limits(settings: CloudSettings) -> str:
    """Return the depths and errors that a cloud takes, in words."""
    farthest = "any depth" if settings.max_range_m is None else f"{settings.max_range_m:g} m"
    limits = f"from {settings.min_range_m:g} m to {farthest}"
    if settings.max_relative_sigma is None:
        return limits
    return f"{limits}, known to {100 * settings.max_relative_sigma:g} % of it"

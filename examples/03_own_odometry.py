"""An odometry of one's own: Open3D's ICP on the cloud of each frame, from the last motion on.

    python examples/03_own_odometry.py [DRIVE [FOLDER]]

Give its class a name in a package, and `recon map DRIVE --odometry NAME` takes it, too:
docs/walk-research.md#run-your-own-odometry
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import open3d as o3d

import recon

Tree = dict[str, np.ndarray]


class IcpOdometry:
    """Registers the points of a frame to those of the last one, point to plane."""

    name = "icp"

    def __init__(self, voxel_m: float = 0.2, range_m: float = 20.0) -> None:
        self.voxel_m, self.range_m = voxel_m, range_m
        self.restore({"pose": np.eye(4), "step": np.eye(4), "xyz": np.zeros((0, 3))})

    def register(self, frame: recon.OdometryFrame) -> recon.OdometryResult:
        now, last = self.cloud(frame), as_cloud(self.xyz)
        if len(self.xyz) and now.has_points():
            last.estimate_normals()
            method = o3d.pipelines.registration.TransformationEstimationPointToPlane()
            self.step = o3d.pipelines.registration.registration_icp(
                now, last, 5 * self.voxel_m, self.step, method
            ).transformation
            self.pose = self.pose @ self.step
        self.xyz = np.asarray(now.points)
        return recon.OdometryResult(self.pose)

    def cloud(self, frame: recon.OdometryFrame) -> o3d.geometry.PointCloud:
        camera, disparity = frame.pair.camera, frame.disparity.values
        depth_m = camera.focal_px * camera.baseline_m / (disparity + camera.doffs_px)
        v, u = np.nonzero((depth_m > 0) & (depth_m < self.range_m))  # NaN is neither
        ray = np.stack([u - camera.cx_px, v - camera.cy_px, np.full(len(u), camera.focal_px)], 1)
        xyz = ray / camera.focal_px * depth_m[v, u, None]
        return as_cloud(xyz).voxel_down_sample(self.voxel_m)

    def state(self) -> Tree:  # what a drive that was killed goes on with
        return {"pose": self.pose, "step": self.step, "xyz": self.xyz}

    def restore(self, state: Tree) -> None:
        self.pose, self.step, self.xyz = state["pose"], state["step"], state["xyz"]


def as_cloud(xyz: np.ndarray) -> o3d.geometry.PointCloud:
    """Return points (N, 3) as Open3D has them."""
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz.astype(float)))


def main(drive: str | None, folder: Path) -> None:
    """Map a drive with ICP, and with recon's own odometry."""
    config = recon.load_config(overrides=["street.frames=20"])
    source = recon.open_source(drive) if drive else recon.SyntheticSource(config.street)
    for odometry in (IcpOdometry(), "visual"):
        chosen = config.with_odometry(odometry)
        options = recon.MapOptions(out=folder / getattr(odometry, "name", "visual"), mesh=False)
        summary = recon.run_map(source, chosen, options).summary
        error_m = float("nan") if summary.trajectory is None else summary.trajectory.ate_m
        print(f"{summary.odometry}: {summary.path_length_m:.1f} m, error {error_m:.3f} m")


if __name__ == "__main__":
    drive, folder, *_ = [*sys.argv[1:], *([None] * 2)]
    main(drive, Path(folder or "outputs/examples/own_odometry"))

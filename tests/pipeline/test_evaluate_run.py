"""A run is compared in the axes that its record names."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from recon.errors import FormatError
from recon.formats.ply import write_ply
from recon.geometry.se3 import exp_so3, invert, make_transform
from recon.geometry.transform import transform_cloud
from recon.pipeline.evaluate_run import compare_maps
from recon.structures import PointCloud

T_MAP_WORLD = make_transform(exp_so3(np.array([0.3, -1.2, 0.8])), np.zeros(3))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    cloud = PointCloud(rng.uniform(-5, 5, (2000, 3)).astype(np.float32), frame="map")
    folder = tmp_path / "run"
    write_ply(folder / "map" / "cloud.ply", cloud)
    (folder / "run.json").write_text(json.dumps({"T_map_world": T_MAP_WORLD.tolist()}))
    write_ply(tmp_path / "in_map.ply", cloud)
    in_camera = transform_cloud(cloud, invert(T_MAP_WORLD), frame="camera")
    write_ply(tmp_path / "in_camera.ply", in_camera)
    return folder


@pytest.mark.parametrize("inside", ["", "map/cloud.ply"])
@pytest.mark.parametrize("frame", ["camera", "map"])
def test_a_run_equals_itself_in_either_frame(run: Path, inside: str, frame: str) -> None:
    reference = run.parent / f"in_{frame}.ply"
    figures = compare_maps(run / inside, reference, frame=frame, threshold_m=0.2)
    assert figures["f_score"] == 1.0
    # Both clouds are thinned on grids that start elsewhere, after a rotation of float32 points.
    assert 0.0 <= figures["p95_m"] < 0.15


def test_the_wrong_frame_does_not_fit(run: Path) -> None:
    figures = compare_maps(run, run.parent / "in_map.ply", frame="camera", threshold_m=0.2)
    assert figures["f_score"] < 0.5


def test_a_cloud_of_no_run_is_taken_as_it_is(run: Path) -> None:
    reference = run.parent / "in_camera.ply"
    figures = compare_maps(reference, reference, frame="camera", threshold_m=0.2)
    assert figures["f_score"] == 1.0


@pytest.mark.parametrize("record", ["{}", "no json", '{"T_map_world": [[1]]}'])
def test_a_broken_record_is_refused(run: Path, record: str) -> None:
    (run / "run.json").write_text(record)
    with pytest.raises(FormatError, match=r"run\.json.*T_map_world|T_map_world.*"):
        compare_maps(run, run.parent / "in_map.ply", frame="camera", threshold_m=0.2)

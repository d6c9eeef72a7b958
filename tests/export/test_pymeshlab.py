"""MeshLab in its child process: failures become one clear line."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import MeshingError
from recon.export.pymeshlab import screened_poisson


def reconstruct(xyz: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, ...]:
    return screened_poisson(
        xyz, normals, depth=5, scale=1.1, samples_per_node=1.5, point_weight=4.0
    )


def ball(n: int = 600) -> np.ndarray:
    directions = np.random.default_rng(0).standard_normal((n, 3))
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)


def test_arrays_come_back_typed_and_matching_and_pymeshlab_is_not_loaded_here() -> None:
    loaded = "pymeshlab" in sys.modules
    vertices, faces, density = reconstruct(ball(), ball())
    assert ("pymeshlab" in sys.modules) == loaded
    assert (vertices.dtype, faces.dtype, density.dtype) == (np.float32, np.int32, np.float32)
    assert len(density) == len(vertices)
    assert 0 <= faces.min() <= faces.max() < len(vertices)


def test_a_poisoned_cloud_is_an_error_and_not_an_empty_mesh() -> None:
    xyz = ball()
    xyz[3] = np.nan
    with pytest.raises(MeshingError):
        reconstruct(xyz, ball())


def test_a_child_that_dies_is_reported_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pymeshlab.py").write_text(
        "import os, signal\nos.kill(os.getpid(), signal.SIGABRT)"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(MeshingError, match=r"failed in MeshLab.*exit code -6") as caught:
        reconstruct(ball(), ball())
    assert "\n" not in str(caught.value)

"""Mesh editing with Open3D, on meshes small enough to count by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import FormatError, OutputError
from recon.core.values import TriangleMesh
from recon.io.models import open3d_meshes


def sheet(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A flat sheet of 2·n² triangles."""
    y, x = np.mgrid[: n + 1, : n + 1]
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(np.float32)
    at = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]).astype(np.int32)
    return vertices, faces


def test_components_are_counted_and_labelled() -> None:
    vertices, faces = sheet(3)
    two = np.concatenate([faces, faces[:4] + len(vertices)])
    labels, sizes = open3d_meshes.component_labels(np.concatenate([vertices, vertices + 99]), two)
    assert sizes[labels[0]] == 18
    assert labels[0] not in labels[18:]


def test_decimation_keeps_a_flat_sheet_flat_and_its_border() -> None:
    vertices, faces = open3d_meshes.decimate(*sheet(12), 40)
    assert len(faces) <= 40
    np.testing.assert_allclose(vertices[:, 2], 0, atol=1e-6)
    # Corners of a border may be cut a little where edges collapse.
    np.testing.assert_allclose(np.ptp(vertices[:, :2], axis=0), 12, atol=0.5)


def test_what_open3d_cannot_read_or_write_is_an_error_of_ours(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    vertices, faces = sheet(1)
    with pytest.raises(OutputError):
        open3d_meshes.write_mesh(tmp_path / "none" / "a.stl", TriangleMesh(vertices, faces))
    (tmp_path / "junk.obj").write_text("junk\n")
    with pytest.raises(FormatError):
        open3d_meshes.read_mesh(tmp_path / "junk.obj")
    assert capfd.readouterr().out == ""

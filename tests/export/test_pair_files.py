"""Files of a pair have what was measured, and beside it, if there is any, what was inferred."""

from dataclasses import replace

import numpy as np
import pytest

from recon.core.errors import MeshingError
from recon.core.values import Disparity, Reason, RectifiedCamera, RectifiedPair
from recon.export.mesh.poisson import MeshSettings
from recon.export.pair import mesh_cloud, mesh_frame, write_cloud_files, write_disparity_files
from recon.io.images.disparity import read_disparity, read_pfm
from recon.io.images.image import read_image
from recon.io.models.ply import read_ply
from recon.stereo.frame import CloudSettings, ReconstructedFrame, back_project

HEIGHT, WIDTH = 40, 64
CAMERA = RectifiedCamera(60.0, 31.5, 19.5, 31.5, 0.1, WIDTH, HEIGHT)
GREY = np.full((HEIGHT, WIDTH), 90, np.uint8)
PAIR = RectifiedPair(GREY, GREY, CAMERA)
INFERRED = ("inferred.pfm", "inferred_confidence.pfm", "inferred_depth.pfm")


def disparity(inferred_from: int) -> Disparity:
    """A wall of 6 px, inferred from a column on; nothing is known of the first row."""
    reason = np.full((HEIGHT, WIDTH), Reason.VALID, np.uint8)
    reason[:, inferred_from:], reason[0] = Reason.FILLED, Reason.LOW_TEXTURE
    known = reason != Reason.LOW_TEXTURE
    values = np.where(known, np.float32(6), np.float32(np.nan))
    return Disparity(values, np.where(known, np.float32(0.5), np.float32(0)), values / 60, reason)


def frame(found: Disparity, **settings: bool) -> ReconstructedFrame:
    cloud = back_project(found, PAIR, CloudSettings(**settings))
    return ReconstructedFrame(PAIR, found, cloud)


def test_negative_disparities_are_in_the_pfm_and_in_no_png(tmp_path):
    found = disparity(WIDTH)
    below = replace(found, values=np.where(found.valid, np.float32(-6), found.values))
    assert write_disparity_files(below, tmp_path) is None
    folder = tmp_path / "disparity"
    np.testing.assert_array_equal(read_pfm(folder / "disparity.pfm"), below.values)
    assert not (folder / "disparity.png").exists()
    assert (folder / "reason.png").exists()


@pytest.mark.parametrize("inferred_from", [0, 40, WIDTH])
def test_each_file_has_one_kind_and_what_is_not_there_has_no_file(tmp_path, inferred_from):
    found = disparity(inferred_from)
    assert write_disparity_files(found, tmp_path, CAMERA) > 0
    folder = tmp_path / "disparity"
    for name in ("disparity.pfm", "depth.pfm", "disparity.png"):
        np.testing.assert_array_equal(np.isfinite(read_disparity(folder / name)), found.measured)
    sure = read_pfm(folder / "confidence.pfm")
    np.testing.assert_array_equal(sure, np.where(found.measured, found.confidence, 0))
    np.testing.assert_array_equal(read_image(folder / "reason.png"), found.reason)
    there = found.inferred.any()
    assert [(folder / name).exists() for name in INFERRED] == 3 * [there]
    if there:
        beside, sure, depth_m = (read_pfm(folder / name) for name in INFERRED)
        np.testing.assert_array_equal(beside, np.where(found.inferred, 6, np.nan))
        np.testing.assert_array_equal(sure, np.where(found.inferred, np.float32(0.5), 0))
        np.testing.assert_allclose(depth_m, np.where(found.inferred, 1.0, np.nan), rtol=1e-6)


def test_a_cloud_file_says_which_points_were_inferred_where_they_were_asked_for(tmp_path):
    found = disparity(40)
    write_cloud_files(frame(found, inferred=True), None, (), tmp_path)
    both = read_ply(tmp_path / "clouds" / "cloud.ply")
    assert len(both) == found.valid.sum()
    assert both.inferred.sum() == found.inferred.sum()
    write_cloud_files(frame(found), None, (), tmp_path)
    alone = read_ply(tmp_path / "clouds" / "cloud.ply")
    assert len(alone) == found.measured.sum()
    assert alone.inferred is None


def test_a_mesh_has_what_was_inferred_only_where_it_was_asked_for():
    found, settings = disparity(40), MeshSettings(min_component_faces=1)
    farthest = {}
    for asked in (False, True):
        mesh, coverage, _ = mesh_frame(frame(found, inferred=asked), settings)
        assert coverage == 1.0
        farthest[asked] = mesh.vertices[:, 0].max()
    # (39 - 31.5) and (63 - 31.5) pixels right of the centre, at 1 m.
    assert farthest[False] == pytest.approx(7.5 / 60, abs=0.01)
    assert farthest[True] == pytest.approx(31.5 / 60, abs=0.01)


def test_closing_a_surface_behind_covers_no_more_points():
    rng = np.random.default_rng(0)
    rough = disparity(WIDTH)
    values = np.where(rough.valid, 6 + rng.uniform(-2, 2, rough.values.shape), np.nan)
    made = frame(replace(rough, values=values.astype(np.float32)))
    settings = MeshSettings(min_component_faces=1)
    _, alone, _ = mesh_frame(made, settings)
    for thick_m in (0.01, 0.2):
        _, closed, _ = mesh_frame(made, settings.model_copy(update={"pair_solid_m": thick_m}))
        assert closed == pytest.approx(alone, abs=0.01)


def test_a_cloud_that_is_not_that_of_a_pair_is_not_closed_behind(tmp_path):
    cloud = frame(disparity(WIDTH)).cloud
    with pytest.raises(MeshingError, match=r"only the surface of a pair.*pair_solid_m"):
        mesh_cloud(cloud, None, MeshSettings(pair_solid_m=0.1), tmp_path)


def test_coverage_is_of_what_was_measured():
    found = disparity(60)
    nearer = np.where(found.inferred, np.float32(30), found.values)
    made = frame(replace(found, values=nearer), inferred=True)
    # The strip in front is a component of too few faces; with its points it would be 94 %.
    _, coverage, _ = mesh_frame(made, MeshSettings(min_component_faces=1000))
    assert coverage == 1.0
    _, coverage, _ = mesh_frame(frame(disparity(0), inferred=True), MeshSettings())
    assert coverage == 1.0

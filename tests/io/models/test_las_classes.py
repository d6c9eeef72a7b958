"""LAS files say what is ground, what stands on it, and what was inferred."""

from dataclasses import replace

import numpy as np
import pytest

from recon.core.values import PointCloud
from recon.io.models.las import ABOVE_GROUND, GROUND, write_copc, write_las
from tests.io.models.test_clouds_and_grids import example_cloud


def classify(cloud: PointCloud) -> np.ndarray:
    return np.where(cloud.xyz[:, 2] < 0, GROUND, ABOVE_GROUND).astype(np.uint8)


@pytest.mark.parametrize("suffix", ["las", "laz", "copc.laz"])
def test_classes_are_those_of_the_specification_or_named(tmp_path, suffix):
    laspy = pytest.importorskip("laspy")
    path, cloud = tmp_path / f"cloud.{suffix}", example_cloud(500)
    inferred = (cloud.xyz[:, 2] > 1).astype(np.uint8)
    write = write_copc if suffix == "copc.laz" else write_las
    write(path, [replace(cloud, inferred=inferred)], np.eye(4), step_m=0.001, classify=classify)
    found = laspy.read(path)
    np.testing.assert_array_equal(found.classification, np.where(found.z < 0, 2, 64))
    assert 0 < np.sum(np.asarray(found.classification) == 2) < 500
    # A class of a user has a name; what was inferred is synthetic, whatever its class.
    (names,) = found.header.vlrs.get("ClassificationLookupVlr")
    assert names[64] == "above ground"
    assert len(names.record_data_bytes()) == 256 * 16  # as the specification has it
    np.testing.assert_array_equal(found.synthetic, np.asarray(found["inferred"]))
    assert 0 < np.sum(found.synthetic) == inferred.sum() < 500
    write(path, [cloud], np.eye(4), step_m=0.001)
    assert set(laspy.read(path).classification) == {1}
    assert not np.any(laspy.read(path).synthetic)

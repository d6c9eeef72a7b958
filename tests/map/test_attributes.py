"""What a point carries is said once: rows agree with clouds, and one row more is enough."""

import json
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import arrays

from recon.core.errors import FormatError, ShapeError
from recon.core.values import ATTRIBUTES, Attribute, PointCloud
from recon.io.models.columns import columns_of
from recon.map.map import Map
from recon.map.sessions.copying import keep_map
from tests.map import walls

LABEL = Attribute("label", np.uint8, fused="vote", values=4)
FUSED = [each for each in (*ATTRIBUTES, LABEL) if each.fused is not None]
JOINED = {"mean": "mean", "direction": "mean direction", "own": "by fusion", None: "–"}
FORMATS = ("ply", "pcd", "las", "e57", "ros")
SHARES = st.floats(0, 1, width=32)


def test_clouds_have_a_field_for_each_row_and_no_other():
    names = {each.name for each in ATTRIBUTES}
    assert names == {field.name for field in fields(PointCloud)} - {"xyz", "frame"}
    assert len(names) == len(ATTRIBUTES)


@pytest.mark.parametrize("name", FORMATS)
def test_no_format_has_two_columns_of_one_name(name):
    columns = ["x", "y", "z", *(column for each in ATTRIBUTES for column in getattr(each, name))]
    assert len({*columns}) == len(columns)


def test_the_page_of_formats_has_the_names_of_the_rows():
    page = (Path(__file__).parents[2] / "docs" / "formats.md").read_text()
    for each in ATTRIBUTES:
        columns = [" ".join(f"`{column}`" for column in getattr(each, name)) for name in FORMATS]
        cells = [f"`{each.name}`", each.unit, JOINED[each.fused], *columns]
        assert f"| {' | '.join(cells)} |".replace("|  |", "| |").replace("|  |", "| |") in page


@pytest.mark.parametrize("each", ATTRIBUTES, ids=lambda each: each.name)
def test_an_attribute_of_another_type_or_length_is_refused(each):
    cloud = PointCloud(np.zeros((3, 3), np.float32))
    right = np.zeros(each.shape(3), each.dtype)
    assert [*replace(cloud, **{each.name: right}).arrays] == ["xyz", each.name]
    for wrong in (right.astype(np.float64), right[:2], right.tolist()):
        with pytest.raises(ShapeError, match=each.name):
            replace(cloud, **{each.name: wrong})


@given(st.data())
def test_the_mean_of_one_point_is_the_point(data):
    each = data.draw(st.sampled_from(FUSED))
    most = LABEL.values - 1 if each is LABEL else 255
    numbers = st.integers(0, most) if np.issubdtype(each.dtype, np.integer) else SHARES
    values = data.draw(arrays(each.dtype, each.shape(3), elements=numbers))
    if each.fused == "direction":
        values[:, 0] += 1
        values /= np.linalg.norm(values, axis=1, keepdims=True)
    back = each.of_means(each.averaged(values))
    assert (back.dtype, back.shape) == (values.dtype, values.shape)
    # A unit vector is made one again, in single precision.
    np.testing.assert_allclose(back, values, rtol=0, atol=1e-6 * (each.fused == "direction"))


@given(
    arrays(np.uint8, 9, elements=st.integers(0, 3)),
    arrays(np.float32, 9, elements=st.sampled_from([0.5, 1.0, 2.0, 8.0])),  # sums are exact
)
def test_a_vote_is_won_by_weight(labels, weights):
    mean = (weights[:, None] * LABEL.averaged(labels)).sum(axis=0, keepdims=True) / weights.sum()
    won = LABEL.of_means(mean)[0]
    votes = [float(weights[labels == label].sum()) for label in range(4)]
    assert votes[won] == max(votes)


def test_points_of_a_map_say_which_are_inferred_where_they_were_asked_for(monkeypatch, tmp_path):
    plain = walls.wall

    def marked(T_true, seed):
        cloud = plain(T_true, seed)  # camera axes: y is down
        return replace(cloud, inferred=np.uint8(cloud.xyz[:, 1] < 0))

    monkeypatch.setattr(walls, "wall", marked)
    with Map.temporary() as made:
        walls.drive(made, walls.TRUE[0], 0)
        made.commit()
        keep_map(made, tmp_path / "map.recon")
    with Map.open(tmp_path / "map.recon") as map_:
        cloud = walls.cloud_of(map_.tiles())
        low = walls.voxels_of(map_.tiles()).keys[:, 2].max()
    sure = np.abs(cloud.xyz[:, 2]) > 0.1  # a voxel; else one has points of both halves
    np.testing.assert_array_equal(cloud.inferred[sure], cloud.xyz[sure, 2] > 0)
    assert low <= 1  # what was inferred is above, and in no ray


def test_a_colour_is_three_columns_or_the_bits_of_one():
    rgb = np.array([[1, 2, 3], [255, 0, 128]], np.uint8)
    cloud = PointCloud(np.zeros((2, 3), np.float32), rgb)
    assert [*columns_of(cloud, "e57")] == ["colorRed", "colorGreen", "colorBlue"]
    assert columns_of(cloud, "pcd")["rgb"].view("<u4").tolist() == [0x010203, 0xFF0080]


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    """What a program made whose table has one row more: a label, voted."""
    folder = tmp_path_factory.mktemp("labelled")
    subprocess.run([sys.executable, "-m", "tests.map.labelled", folder], check=True)
    return folder


@pytest.mark.slow
def test_with_a_row_more_a_label_goes_from_points_through_the_map_into_files_and_views(labelled):
    found = json.loads((labelled / "found.json").read_text())
    assert found["known"] == [["rgb", "normals", "sigma_m", "label"], ["rgb", "normals", "sigma_m"]]
    assert found["points"] > 100
    assert found["right"] > 0.95  # of the points themselves, 0.825
    assert (found["read"], found["joined"]) == (True, True)
    assert {2, 5} <= set(found["thinned"]) <= set(range(8))
    assert found["sent"][-1] == ["label", 2]  # a byte
    assert found["colourings"][-1] == "label"
    assert 2 <= found["drawn"] <= 8
    with np.load(labelled / "cloud.npz") as arrays_:
        label = arrays_["label"]
    assert (label.dtype, len(label)) == (np.uint8, found["points"])
    head = (labelled / "cloud.pcd").read_bytes().split(b"DATA", 1)[0].decode().splitlines()
    assert [line.split()[-1] for line in head[3:6]] == ["label", "1", "U"]
    laspy = pytest.importorskip("laspy")
    assert "label" in laspy.read(labelled / "cloud.las").point_format.extra_dimension_names


@pytest.mark.slow
def test_such_a_map_is_refused_by_who_does_not_know_the_label(labelled):
    with Map.open(labelled / "map.recon") as map_, pytest.raises(FormatError) as refused:
        list(map_.session().submaps)
    assert "attribute that this version does not know" in str(refused.value)
    assert "label" in str(refused.value)
    with Map.open(labelled / "map.recon") as map_:  # what was mapped without
        assert len(map_.session(1).submaps[0].fused) > 0

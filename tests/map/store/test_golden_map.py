"""A map that recon 1.0.0 wrote, kept as it was, opens and gives what it gave then."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import FormatError
from recon.core.geometry.se3 import invert
from recon.map.localize.localizer import State
from recon.map.map import Map
from recon.map.sessions.placed import settings_of
from tests.map.store import golden
from tests.map.walls import cloud_of, voxels_of
from tests.scenery.film import film

FILE = Path(__file__).with_name("format_2.recon")
# Means over all points, as the version that wrote the file gave them.
CLOUD = {
    "xyz": [10.049688, -2.766401, 0.698225], "rgb": [75.895833, 82.229167, 74.083333],
    "normals": [-0.190286, 0.300211, -0.034567], "sigma_m": 0.150412, "confidence": 0.875438,
    "weight": 5252.745768, "count": 1.958333,
}  # fmt: skip
VIEWS, VOXELS, RAYS = [377, 413, 372], 693, 4256  # features of each keyframe; of the first drive
SUMS = [
    2649231.924, -61139.034, 7447.954, 2310.435, 265813994.125, 268886523.625, 269038014.375,
    -520474.696, -1833464.107, -384863.399, 2439487.873,
]  # fmt: skip


@pytest.fixture(scope="module")
def map_():
    with Map.open(FILE) as opened:
        yield opened


def test_drives_and_the_places_that_link_them_are_those_that_were_written(map_):
    first, second = map_.linked
    assert [len(first), len(second)] == [6, 3]
    assert [session.keyframes.frames for session in (first, second)] == [[0, 2, 4], [0, 1, 2]]
    assert [link.sessions for link in map_.links] == [(0, 1)] * 4
    assert all(placed.all() for placed in map_.placed.values())
    end_m = first.trajectory.positions_m[-1]
    np.testing.assert_allclose(end_m, [-0.196640, -0.101329, 5.046374], rtol=0, atol=1e-6)
    begin_m = second.T_map_world[:3, 3]
    np.testing.assert_allclose(begin_m, [1.005264, 0.028528, 0.023899], rtol=0, atol=1e-6)
    assert [len(view.keyframe.uvd) for view in first.keyframes] == VIEWS


def test_what_frames_saw_is_what_was_written(map_):
    session = map_.session()
    sums = np.concatenate([submap.fused.sums for submap in session.submaps])
    rays = [session.rays(frame)[0] for frame in range(len(session))]
    assert (len(sums), sum(map(len, rays))) == (VOXELS, RAYS)
    np.testing.assert_allclose(sums.sum(axis=0, dtype=np.float64), SUMS, rtol=1e-6)


def test_cloud_and_occupancy_are_as_then(map_):
    tiles = map_.tiles()
    cloud, voxels = cloud_of(tiles), voxels_of(tiles)
    assert (len(cloud), len(voxels.keys), int((voxels.log_odds > 0).sum())) == (48, 413, 270)
    for name, mean in CLOUD.items():
        np.testing.assert_allclose(getattr(cloud, name).mean(axis=0), mean, rtol=1e-4, atol=1e-5)
    assert voxels.log_odds.mean() == pytest.approx(0.604073, abs=1e-4)


def test_a_pair_of_the_street_is_found_where_it_was_taken(map_):
    street = film(golden.STREET)
    found = map_.localize(street.pairs[3], street.calibration)
    assert found.state is State.TRACKING
    off = invert(street.trajectory.T_world_camera[3]) @ found.T_world_camera
    assert np.linalg.norm(off[:3, 3]) < 0.01


def test_its_settings_are_those_of_today(map_):
    assert settings_of(map_.session()).matching == golden.CONFIG.matching


@pytest.mark.parametrize(("number", "words"), [
    (99, r"a newer version of recon \(got format 99"), (1, "before 1.0.*map the drive again"),
])  # fmt: skip
def test_a_map_of_another_format_is_refused_by_its_number(number, words, tmp_path):
    other = tmp_path / "map.recon"
    shutil.copy(FILE, other)
    content = bytearray(other.read_bytes())
    content[60:64] = number.to_bytes(4, "big")  # where SQLite keeps `user_version`
    other.write_bytes(content)
    with pytest.raises(FormatError, match=words):
        Map.open(other)

"""Positions of receivers in recordings."""

from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import ReconError
from recon.sources.bag import read_measured
from tests.sources.bags import Recording, recorder

PLACES = np.column_stack([49.0 + 1e-5 * np.arange(8), np.full(8, 8.4), 115 + 0.1 * np.arange(8)])
START_NS = 1_700_000_000_000_000_000


def write(
    folder, kind="mcap", topics=("/gps/fix",), sigma_m=(0.02, 0.01, 0.03), places=PLACES, **how
):
    with recorder(folder, Recording(kind)) as bag:
        bag.write("/imu", START_NS, bag.imu(START_NS, np.zeros(3), np.zeros(3), "imu"))
        for number, place in enumerate(places):
            time_ns = START_NS + 100_000_000 * number
            for topic in topics:
                bag.write(topic, time_ns + 5_000_000, bag.fix(time_ns, place, sigma_m, **how))
    return Recording(kind).path(folder)


@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap"])
def test_positions_have_the_times_of_their_headers_and_the_spread_of_their_covariance(
    tmp_path, kind
):
    found = read_measured(write(tmp_path, kind))
    np.testing.assert_allclose(found.times_s, START_NS / 1e9 + 0.1 * np.arange(8), atol=1e-6)
    np.testing.assert_allclose(found.places, PLACES, rtol=1e-12)
    np.testing.assert_allclose(found.sigma_m, np.tile([0.02, 0.01, 0.03], (8, 1)))
    assert (found.degrees, found.heights) == (True, "the ellipsoid")


def test_what_is_not_known_is_not_invented(tmp_path):
    path = write(tmp_path, sigma_m=None)
    assert np.isnan(read_measured(path).sigma_m).all()
    endless = write(tmp_path / "endless", sigma_m=np.full(3, np.inf))
    assert np.isnan(read_measured(endless).sigma_m).all()
    with pytest.raises(ReconError, match="no position"):
        read_measured(write(tmp_path / "none", status=-1))


@pytest.mark.parametrize("height_m", [np.nan, np.inf, 1e300, -1e20])
def test_a_message_without_a_height_on_earth_is_left_out(tmp_path, height_m):
    places = PLACES.copy()
    places[3, 2] = height_m
    found = read_measured(write(tmp_path, places=places))
    np.testing.assert_allclose(found.places, np.delete(PLACES, 3, axis=0), rtol=1e-12)


def test_of_several_receivers_one_is_named(tmp_path):
    path = write(tmp_path, topics=("/front/fix", "/rear/fix"))
    with pytest.raises(ReconError, match=r"several receivers .*/front/fix \(8\).*:/front/fix"):
        read_measured(path)
    assert len(read_measured(Path(f"{path}:/rear/fix")).times_s) == 8
    with pytest.raises(ReconError, match=r"no positions of a receiver .*/front/fix"):
        read_measured(Path(f"{path}:/imu"))


def test_a_recording_without_a_receiver_names_its_topics(tmp_path):
    with pytest.raises(ReconError, match=r"no positions of a receiver .*no NavSatFix among /imu"):
        read_measured(write(tmp_path, topics=()))
    with pytest.raises(ReconError, match="does not exist"):
        read_measured(tmp_path / "missing.bag")

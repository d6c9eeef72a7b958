"""Positions as receivers write them come back in metres, with their quality."""

import numpy as np
import pytest

from recon.core.errors import ReconError
from recon.io.positions import Positions, is_control, read_control, read_positions
from tests.scenery import receivers

pytest.importorskip("pyproj")
TIMES_S = receivers.DAY_S + 40000 + 0.1 * np.arange(30)
PLACES_M = np.column_stack(
    [456789.0 + np.arange(30), 5428210.0 - 0.5 * np.arange(30), 115 + 0.1 * np.arange(30)]
)
SOUTH_M = PLACES_M + np.array([0.0, 1e6, 0.0])


@pytest.fixture
def degrees():
    return receivers.degrees_of(PLACES_M, "EPSG:25832")


@pytest.mark.parametrize(
    ("write", "sigma_m", "sunk_m"),
    [
        (receivers.write_nmea, (0.016, 0.016, 0.024), receivers.GEOID_M),
        (receivers.write_oxts, (0.05, 0.05, 0.05), 0.0),
        (receivers.write_rtklib, (0.02, 0.01, 0.03), 0.0),
        (receivers.write_ecef, (0.02, 0.01, 0.03), 0.0),
        (receivers.write_degrees, (np.nan,) * 3, 0.0),
    ],
)
def test_what_receivers_write_is_read(tmp_path, degrees, write, sigma_m, sunk_m):
    found = read_positions(write(tmp_path / "gnss", TIMES_S, degrees))
    np.testing.assert_allclose(found.times_s, TIMES_S, atol=0.0011)
    metres, crs = found.projected(None, "gnss")
    assert crs == "EPSG:32632"
    assert np.abs(metres + np.array([0, 0, sunk_m]) - PLACES_M).max() < 0.001
    np.testing.assert_allclose(found.sigma_m, np.tile(sigma_m, (30, 1)), rtol=1e-4)
    # Heights above the geoid do not become those above the ellipsoid, nor the other way round.
    metres, _ = found.projected("EPSG:25832+7837", "gnss")
    assert np.abs(metres[:, 2] + sunk_m - PLACES_M[:, 2]).max() < 0.001


def test_in_the_south_and_the_west(tmp_path):
    degrees = receivers.degrees_of(SOUTH_M, "EPSG:32722")
    found = read_positions(receivers.write_nmea(tmp_path / "gnss", TIMES_S, degrees))
    metres, crs = found.projected(None, "gnss")
    assert crs == "EPSG:32722"
    assert np.abs(metres[:, :2] - SOUTH_M[:, :2]).max() < 0.001


@pytest.mark.parametrize(
    ("crs", "why"),
    [
        ("EPSG:32600", r"--crs: positions cannot be converted.*UTM grid system \(northern"),
        ("IAU_2015:30120", r"gnss: positions cannot be converted.*IAU_2015:30120"),  # of the Moon
    ],
)
def test_a_system_that_positions_on_earth_have_not_is_refused(degrees, crs, why):
    found = Positions(TIMES_S, degrees, np.full_like(degrees, np.nan), degrees=True)
    with pytest.raises(ReconError, match=why):
        found.projected(crs, "gnss")


@pytest.mark.parametrize(
    ("head", "why"),
    [
        ("WGS84 UTM 0S", "unknown coordinate system"),
        ("WGS84 UTM 61N", "unknown coordinate system"),  # with the number of a polar system
        ("EPSG:32700", "cannot be converted"),
        ("EPSG:2263", "easting and northing in metres"),
    ],
)
def test_a_system_of_control_points_that_there_is_not_is_refused_by_their_file(tmp_path, head, why):
    path = tmp_path / "gcp.txt"
    path.write_text(f"{head}\n500000 5400000 100 10 10 left.png a\n")
    assert is_control(path)
    with pytest.raises(ReconError, match=rf"gcp\.txt: .*{why}"):
        read_control(path)


@pytest.mark.parametrize(
    ("crs", "refused"),
    [
        ("EPSG:25832", False),
        ("EPSG:25832+7837", False),  # with heights
        ("EPSG:32632", False),
        ("+proj=utm +zone=32 +ellps=GRS80", False),
        ("EPSG:25833", True),
        ("EPSG:31467", True),
    ],
)
def test_control_points_of_one_system_are_not_said_to_be_of_another(tmp_path, crs, refused):
    path = tmp_path / "gcp.txt"
    path.write_text("EPSG:25832\n500000 5400000 100 10 10 left.png a\n")
    if refused:
        with pytest.raises(ReconError, match=r"another coordinate system .got EPSG:25832, exp"):
            read_control(path, crs)
    else:
        found = read_control(path, crs)
        assert (found.system, *found.points[0].place_m) == (crs, 500000, 5400000, 100)


def test_nmea_over_midnight_and_damaged_sentences(tmp_path, degrees):
    times_s = receivers.DAY_S - 1.0 + 0.1 * np.arange(30)
    path = receivers.write_nmea(tmp_path / "gnss", times_s, degrees)
    lines = path.read_text().splitlines(keepends=True)
    lines[5] = lines[5].replace("N", "S")  # its checksum is wrong now
    lines[7] = lines[7].split(",4,12", 1)[0] + "\n"
    path.write_text("".join(lines))
    found = read_positions(path)
    np.testing.assert_allclose(found.times_s, np.delete(times_s, [2, 3]), atol=0.0011)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("$GPGGA,1,2,3*00\n", "no sentence has a position"),
        ("% program : RTKLIB\n%  GPST  x-ecef(m) y-ecef(m)\n2011/09/26 1 2 3\n", "out-solformat"),
        ("time,lat,lon\n1,2,3\n", "lacks a column .got no height"),
        ("time,lat,lon,alt\n", "no position"),
        ("time,lat,lon,alt\n1,2,x,4\n", "not a row of numbers"),
        ("time,lat,lon,alt\n1,0,0,4\n", "no position"),
        ("time,lat,lon,alt\n1,108.4,49,4\n", "are the two swapped"),
    ],
)
def test_what_is_none_is_one_line(tmp_path, text, said):
    (tmp_path / "gnss.txt").write_text(text)
    with pytest.raises(ReconError, match=said):
        read_positions(tmp_path / "gnss.txt")


def test_a_folder_that_is_not_oxts_is_refused(tmp_path):
    with pytest.raises(ReconError, match="not one of OXTS"):
        read_positions(tmp_path)

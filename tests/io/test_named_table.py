"""Tables as surveyors write them: what is read of each, or why not."""

import numpy as np
import pytest

from recon.core.errors import FormatError
from recon.io.positions import is_control, read_control, read_positions

pytest.importorskip("pyproj")
EAST, NORTH, UP = 455810.5, 5429311.25, 113.5
LAT, LON = 52 + 31 / 60 + 12.3 / 3600, -(13 + 24 / 60 + 18 / 3600)

#: All are one position at 1.5 s.
METRES = {
    "as documented": "1.5 455810.5 5429311.25 113.5\n",
    "with commas": "1.5,455810.5,5429311.25,113.5\n",
    "with semicolons": "1.5;455810.5;5429311.25;113.5\n",
    "with decimal commas": "1,5;455810,5;5429311,25;113,5\n",
    "with tabs and decimal commas": "1,5\t455810,5\t5429311,25\t113,5\n",
    "as Windows saves it": "\ufeff1.5;455810.5;5429311.25;113.5\r\n",
    "with comments": "# of Monday\n// by hand\n1.5 455810.5 5429311.25 113.5  // kerb\n",
    "a header in another order": "height,northing,easting,time\n113.5,5429311.25,455810.5,1.5\n",
    "letters": "T;E;N;H\n1,5;455810,5;5429311,25;113,5\n",
    "axes": "time x y z\n1.5 455810.5 5429311.25 113.5\n",
    "northing first": "t,N,E,Z\n1.5,5429311.25,455810.5,113.5\n",
    "units": "Time (s);Easting [m];Northing [m];Elevation_m\n1,5;455810,5;5429311,25;113,5\n",
    "a header in a comment": "# time north east up\n1.5 5429311.25 455810.5 113.5\n",
    "what nobody needs": "Point,Time,N,E,Z,D\n7,1.5,5429311.25,455810.5,113.5,'kerb, low'\n",
    "quoted names": '"Pt","t","E","N","H"\n"a, b",1.5,455810.5,5429311.25,113.5\n',
    "German": "Zeit;Punkt;Rechtswert;Hochwert;H;t\nx;1;455810,5;5429311,25;113,5;1,5\n",
}
DEGREES = {
    "decimals": f"time,lat,lon,alt\n1.5,{LAT!r},{LON!r},113.5\n",
    "longitude first": f"lon;lat;t;h\n{LON!r};{LAT!r};1,5;113,5\n",
    "signs": "time,lat,lon,alt\n1.5,52°31'12.3\",-13°24'18\",113.5\n",
    "sides": "time,lat,lon,alt\n1.5,52°31'12.3\"N,13°24'18\"W,113.5\n",
    "sides first": "time;lat;lon;alt\n1,5;N 52° 31' 12,3\";W13°24'18\";113,5\n".replace(",3", ".3"),
    "colons": "time lat lon alt\n1.5 52:31:12.3 -13:24:18 113.5\n",
    "primes": "time,lat,lon,alt\n1.5,52°31\u203212.3\u2033N,13°24\u203218\u2033W,113.5\n",
    "typographic": "time,lat,lon,alt\n1.5,52°31\u201912.3\u201dN,13º24\u201918\u201dW,113.5\n",
    "quoted": 'time,lat,lon,alt\n1.5,"52°31\'12.3""N","13°24\'18""W",113.5\n',
}
REFUSED = {
    "time;northing;height\n1;2;3\n": "lacks a column .got no east, expected time, east, north",
    "point,northing,easting,elevation,description\n1,2,3,4,x\n": "got no time, .*points image",
    "E,N,H\n1,2,3\n": "got no time",
    "time,x,easting,y,z\n1,2,3,4,5\n": "two columns may be the east .got x, easting",
    "time,e,n,h,z\n1,2,3,4,5\n": "two columns may be the height .got h, z",
    "time,easting (ft),northing (ft),height\n1,2,3,4\n": "got no east, north",
    "time,x (north),y (east),z\n1,2,3,4\n": "got no east, north",
    "time,e,n,h\n1,2,3\n": "t.csv:2: a row lacks a field",
    "time,e,n,h\n1,2,x,4\n": "t.csv:2: not a row of numbers",
    "time,e,n,h\n1,5,2,5,3,5,4,5\n": "t.csv:2: a row has more fields .*commas in decimals",
    "point,time,e,n,h,fix\n,1,2,3,,4\n": "t.csv:2: not a row of numbers",
    "1,5,2,5,3,5,4,5\n": "quaternion is not of unit length",
    "1,2,3,4\n1,5,2,5,3,5,4,5\n": "t.csv:2: wrong number of columns",
    "t;e;n;h\n0.5;455,810;429,311;113\n": "t.csv:2: decimals or thousands .got 0.5;455",
    "t;e;n;h\n0;455.810;429.311;113\n1,5;2;3;4\n": "t.csv:2: decimals or thousands",
    "time,lat,lon,h\n1,52°31'12\"E,13°24'18\"E,4\n": "t.csv:2: not a lat",
    "time,lat,lon,h\n1,52°61'12\"N,13°24'18\"E,4\n": "not a row of numbers",
    "time,e,n,h\n": "no position",
    "1.000,5;455.810,5;5.429.311,25;113,5\n": "not a number",
    "1 2 3\n": "wrong number of columns",
    "point 1 is here\n": "wrong number of columns|not a number",
    "1,5 2,5 3,5 4,5\n": "decimals are written with a comma",
}


def written(folder, text):
    (folder / "t.csv").write_bytes(text.encode())
    return folder / "t.csv"


@pytest.mark.parametrize("form", METRES)
def test_metres_are_read_however_they_are_written(tmp_path, form):
    found = read_positions(written(tmp_path, METRES[form]))
    assert not found.degrees
    np.testing.assert_array_equal(found.times_s, [1.5])
    np.testing.assert_array_equal(found.places, [[EAST, NORTH, UP]])
    assert np.isnan(found.sigma_m).all()
    assert not is_control(tmp_path / "t.csv")


@pytest.mark.parametrize("form", DEGREES)
def test_degrees_are_read_however_they_are_written(tmp_path, form):
    found = read_positions(written(tmp_path, DEGREES[form]))
    assert found.degrees
    np.testing.assert_allclose(found.places, [[LAT, LON, UP]], rtol=1e-14)


def test_a_field_that_is_empty_moves_no_other(tmp_path):
    text = "point,time,e,n,h,fix\n,1.5,455810.5,5429311.25,113.5,4\n"
    np.testing.assert_array_equal(
        read_positions(written(tmp_path, text)).places, [[EAST, NORTH, UP]]
    )


@pytest.mark.parametrize("text", REFUSED)
def test_what_is_not_clear_is_one_line(tmp_path, text):
    with pytest.raises(FormatError, match=REFUSED[text]) as told:
        read_positions(written(tmp_path, text))
    assert "\n" not in str(told.value)


def test_deviations_of_a_header(tmp_path):
    text = "time,N,E,H,sigma_n,sigma_e,sigma_u\n1,5429311,455810,113,0.02,0.01,0.03\n"
    found = read_positions(written(tmp_path, text))
    np.testing.assert_array_equal(found.sigma_m, [[0.01, 0.02, 0.03]])
    text = "time,N,E,H,sigma\n1,5429311,455810,113,0\n"
    with pytest.raises(FormatError, match="deviation is not above 0"):
        read_positions(written(tmp_path, text))


HEAD = "EPSG:25832\n"
#: All are one point, which two images show.
CONTROL = {
    "as documented": HEAD + "455810.5 5429311.25 113.5 {} {} {} kerb\n",
    "the name first": HEAD + "kerb 455810.5 5429311.25 113.5 {} {} {}\n",
    "semicolons": HEAD + "455810,5;5429311,25;113,5;{};{};{};kerb\n",
    "tabs": HEAD + "455810.5\t5429311.25\t113.5\t{}\t{}\t{}\tkerb\n",
    "a header": HEAD + "point;N;E;H;u;v;image\nkerb;5429311,25;455810,5;113,5;{};{};{}\n",
    "PNEZD": HEAD + "P,N,E,Z,D,col,row,image\nkerb,5429311.25,455810.5,113.5,x,{},{},{}\n",
    "a system by --crs": "name,x,y,z,u,v,file\nkerb,455810.5,5429311.25,113.5,{},{},{}\n",
    "comments": "# a\n" + HEAD + "// b\n455810.5 5429311.25 113.5 {} {} {} kerb  # c\n",
}


@pytest.mark.parametrize("form", CONTROL)
def test_control_points_are_read_however_they_are_written(tmp_path, form):
    *head, row = CONTROL[form].splitlines(keepends=True)
    rows = [row.format(1, 2, "a.png"), row.format(3, 4, "b.png")]
    path = written(tmp_path, "".join((*head, *rows)))
    assert is_control(path)
    crs = "EPSG:25832" if "--crs" in form else None
    found = read_control(path, crs)
    (point,) = found.points
    assert (found.system, point.name, point.check) == ("EPSG:25832", "kerb", False)
    np.testing.assert_array_equal(point.place_m, [EAST, NORTH, UP])
    assert [(image, *pixel) for image, pixel in point.seen] == [("a.png", 1, 2), ("b.png", 3, 4)]


def test_control_points_in_degrees_with_check_points(tmp_path):
    rows = "a,52°31'12.3\"N,13°24'18\"W,113.5,1,2,a.png,\nb,52.5,-13.4,113.5,1,2,a.png,Check\n"
    path = written(tmp_path, "name,lat,lon,h,u,v,image,check\n" + rows)
    assert read_control(written(tmp_path, HEAD + path.read_text())).system == "EPSG:25832"
    written(tmp_path, "EPSG:4326\n" + path.read_text().replace(HEAD, ""))
    assert read_control(path).system == "EPSG:32628"
    found = read_control(written(tmp_path, path.read_text().replace("EPSG:4326\n", "")))
    assert found.system == "EPSG:32628"
    assert [(one.name, one.check) for one in found.points] == [("a", False), ("b", True)]
    assert abs(found.points[0].place_m[2] - 113.5) < 1e-9


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name,x,y,z,u,v,image\na,1,2,3,4,5,a.png\n", "no coordinate system .expected a first"),
        (HEAD + "name,x,y,z,image\na,1,2,3,a.png\n", "got no column, row"),
        (HEAD + "name,x,y,z,u,v,image\na,1,2,3,4,5\n", r"t\.csv:3: a row lacks a field"),
        (HEAD + "1 2 3 4 5 a.png a b\n", "not a control point"),
        (HEAD + "name,x,y,z,u,v,image\na,1,2,3,4,?,a.png\n", "not five numbers"),
        (HEAD + "name,x,y,z,u,v,image,check\na,1,2,3,4,5,a.png,yes\n", "got yes, expected check"),
    ],
)
def test_control_points_that_lack_something_are_one_line(tmp_path, text, said):
    with pytest.raises(FormatError, match=said):
        read_control(written(tmp_path, text))


def test_a_check_point_without_a_name_is_one(tmp_path):
    text = "x,y,z,u,v,image,check\n1,2,3,4,5,a.png,check\n2,2,3,4,5,a.png,\n"
    found = read_control(written(tmp_path, HEAD + text))
    assert [one.check for one in found.points] == [True, False]

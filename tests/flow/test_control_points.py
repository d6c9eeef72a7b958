"""A map is placed by points that images show and a survey has measured."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import run_settings
from recon.commands.demo import demo_source
from recon.core.geometry.se3 import apply, exp_so3, make_transform
from recon.core.values.camera import project, unproject
from recon.map.ground.axes import AXES_MAP_WORLD
from tests.flow.runs import summary_of
from tests.hostile.refusals import assert_refused, run

pytest.importorskip("pyproj")
T_SURVEY_TRUE = make_transform(
    exp_so3(np.array([0.0, 0.0, 0.7])), np.array([455_800.0, 5_429_300.0, 115.0])
) @ make_transform(AXES_MAP_WORLD, np.zeros(3))
HEAD = "EPSG:25832"
PIXELS = ((60, 70), (200, 60), (30, 20), (220, 25), (128, 80), (90, 60), (160, 75))


@pytest.fixture(scope="module")
def rows(small_demo):
    """Points on the surface of the rendered street, each where two frames show it."""
    source, found = demo_source(run_settings(small_demo)), []
    poses, camera = source.trajectory.T_world_camera, source.calibration
    first, later = source.frame(0), source.frame(3)
    for number, (u, v) in enumerate(PIXELS):
        depth_m = float(first.depth_m[v, u])
        if not depth_m < 15.0:
            continue
        xyz = unproject(*(np.array([float(x)]) for x in (u, v, depth_m)), camera)
        world = apply(poses[0], xyz)
        east, north, up = apply(T_SURVEY_TRUE, world)[0]
        row = f"{east:.4f} {north:.4f} {up:.4f}"
        found.append(f"{row} {u} {v} 0 p{number}")
        inside = apply(np.linalg.inv(poses[3]), world)
        x, y, _ = (float(each[0]) for each in project(inside, camera))
        if 0 <= x < 255 and 0 <= y < 95:
            seen_m = float(later.depth_m[round(y), round(x)])
            if abs(seen_m - inside[0, 2]) < 0.02 * seen_m:
                found.append(f"{row} {x:.3f} {y:.3f} 3 p{number}")
    return found


@pytest.fixture
def placed(small_demo, tmp_path):
    """What an export by such a file says."""

    def export(lines, *words, head=HEAD):
        file = tmp_path / "gcp_list.txt"
        file.write_text("\n".join([head, *lines]) + "\n")
        out = tmp_path / "out"
        to = words or ("--to", "laz")
        words = ("--georeference", file, "--out", out, "--verbose")
        return run("export", small_demo, *to, *words), out

    return export


def test_the_map_lies_where_its_control_points_are(rows, placed, small_demo):
    names = {row.split()[6] for row in rows}
    assert len(names) >= 5
    assert len(rows) > len(names)
    done, out = placed(rows)
    assert done.code == 0, done.err
    summary = summary_of(out)
    T_map_world = np.array(summary_of(small_demo)["T_map_world"])
    off = np.linalg.inv(T_SURVEY_TRUE) @ np.array(summary["T_survey_map"]) @ T_map_world
    assert np.linalg.norm(off[:3, 3]) < 0.15
    assert set(summary["control"]) == names
    assert re.search(r"control\.p\d\.north_m +│ -?0\.\d+ m", done.out)
    for one in summary["control"].values():
        apart = np.linalg.norm([one["east_m"], one["north_m"], one["up_m"]])
        assert apart < 4 * one["sigma_m"]
    assert not [line for line in summary["warnings"] if "control" in line]
    assert (
        pytest.importorskip("laspy").read(out / "map/cloud.laz").header.parse_crs().to_epsg()
        == 25832
    )


def test_degrees_and_the_names_of_other_programs_say_the_same(rows, placed):
    import pyproj

    convert = pyproj.Transformer.from_crs(HEAD, "EPSG:4326", always_xy=True)
    there = []
    for row in rows:
        east, north, *rest = row.split()
        lon, lat = convert.transform(float(east), float(north))
        there.append(" ".join([f"{lon:.10f}", f"{lat:.10f}", *rest]))
    metres, degrees, named = (
        summary_of(placed(lines, head=head)[1])
        for lines, head in ((rows, HEAD), (there, "EPSG:4326"), (rows, "WGS84 UTM 32N"))
    )
    for other in (degrees, named):
        np.testing.assert_allclose(other["T_survey_map"], metres["T_survey_map"], atol=1e-3)


def test_a_typing_error_is_named_and_check_points_are_only_compared(rows, placed):
    names = [*dict.fromkeys(row.split()[6] for row in rows)]
    wrong = [
        row.replace(" 4557", " 4547").replace(" 4558", " 4548") if row.endswith(names[1]) else row
        for row in ["".join([" ", row]) for row in rows]
    ]
    checked = [f"{row} check" if row.endswith(names[0]) else row for row in wrong]
    done, out = placed(checked)
    assert done.code == 0, done.err
    summary = summary_of(out)
    assert any(f"control point {names[1]} contradicts" in line for line in summary["warnings"])
    assert summary["positions_left_out"] == 1
    assert summary["control"][names[0]]["check"]
    used = [name for name, one in summary["control"].items() if one["used"]]
    assert used == names[2:]
    honest = summary["control"][names[0]]
    assert abs(honest["east_m"]) < 4 * honest["sigma_m"]


def three(rows, apart):
    """One sight three times, named a, b and c, and moved in the survey and in the image."""
    *place, u, v, image, _ = rows[0].split()
    lines = []
    for name, (*moved, x, y) in zip("abc", apart, strict=True):
        there = " ".join(str(float(one) + by) for one, by in zip(place, moved, strict=True))
        lines.append(f"{there} {int(u) + x} {int(v) + y} {image} {name}")
    return lines


@pytest.mark.parametrize("apart", [
    [(0, 0, 0, 0, 0)] * 3,
    [(0, 0, 0, 0, 0), (0.01, 0, 0, 1, 0), (0, 0.01, 0, 0, 1)],
    [(0, 0, 0, 0, 0), (0, 0, 0.5, 0, -3), (0, 0, 1.0, 0, -6)],
])  # fmt: skip
def test_points_that_fix_no_direction_are_refused(rows, placed, apart):
    done, out = placed(three(rows, apart))
    assert_refused(done, "the control points do not say how the map is turned")
    assert not out.exists()


def test_how_well_points_fix_the_rotation_is_stated_with_what_it_means_at_the_edge(rows, placed):
    done, out = placed(rows)
    summary = summary_of(out)
    assert 0.0 < summary["yaw_sigma_deg"] < 3.0
    assert summary["yaw_sigma_deg"] <= summary["rotation_sigma_deg"] < 3.0
    assert 0.0 < summary["edge_sigma_m"] < 2.0
    assert "edge_sigma_m" in done.out


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rows: rows[:2], "too few control points"),
        (lambda rows: ["1 2 3 1 1 0 sky"], "without depth where it is seen: sky"),
        (lambda rows: [rows[0].replace(" 0 p", " 99 p"), *rows[1:]], "no such image in the drive"),
        (lambda rows: [rows[0].replace(" 60 70 ", " 6000 70 "), *rows[1:]], "no such pixel"),
        (lambda rows: [rows[0] + " twice", *rows[1:]], "gcp_list.txt:2: not a control point"),
        (lambda rows: ["a b c 1 2 0 x"], "gcp_list.txt:2: not five numbers"),
        (lambda rows: [], "no control point"),
        (lambda rows: [rows[0].replace(" 60 70 ", " nan 70 "), *rows[1:]], "not five numbers"),
        (lambda rows: [*rows, "1 2 3 10 10 0 p0"], "one point has several places"),
    ],
)
def test_what_cannot_be_used_is_one_line_and_leaves_nothing(rows, placed, change, said):
    done, out = placed(change(rows))
    assert_refused(done, said)
    assert not out.exists()


def test_a_system_that_there_is_not_is_refused(rows, placed):
    assert_refused(placed(rows, head="EPSG:99999")[0], "unknown coordinate system")
    assert_refused(placed(rows, head="EPSG:2263")[0], "easting and northing in metres")  # feet


def test_an_antenna_of_control_points_and_another_system_are_refused(rows, placed):
    done, out = placed(rows, "--to", "dsm", "--antenna", "0,0,1")
    assert_refused(done, "--antenna: control points have no antenna")
    done, out = placed(rows, "--to", "dsm", "--crs", "EPSG:25833")
    assert_refused(done, "another coordinate system")
    assert not out.exists()


def test_paths_are_not_bent_by_control_points(rows, small_demo, tmp_path):
    (tmp_path / "gcp.txt").write_text("\n".join([HEAD, *rows]))
    done = run("merge", small_demo, "--georeference", tmp_path / "gcp.txt", "--out", tmp_path / "o")
    assert_refused(done, "control points have no times")


def strict(out):
    def refused(constant):
        raise AssertionError(constant)

    return json.loads((out / "accuracy.json").read_text(), parse_constant=refused)


def without(accuracy, name):
    """What a report says that does not depend on a check point."""
    kept = dict(accuracy["survey"]["control"])
    del kept[name]
    placed = {key: one for key, one in accuracy["survey"].items() if key != "control"}
    same = {key: accuracy[key] for key in ("spreads", "system", "drives")}
    errors, files = accuracy["errors"]["control"], accuracy["sha256"]["products"]
    return {"points": kept, "survey": placed, "errors": errors, "files": files, **same}


@pytest.fixture
def checked(rows, placed):
    """What an export says with one check point, and the same with it moved by so many metres."""
    name = rows[0].split()[6]

    def export(*moved_m):
        lines = []
        for row in rows:
            *place, u, v, image, point = row.split()
            if point == name:
                by = moved_m or (0.0, 0.0, 0.0)
                place = [f"{float(x) + m:.4f}" for x, m in zip(place, by, strict=True)]
                point += " check"
            lines.append(" ".join([*place, u, v, image, point]))
        done, out = placed(lines)
        assert done.code == 0, done.err
        return strict(out), summary_of(out), (out / "accuracy.html").read_text()

    return name, export


def test_a_check_point_places_nothing_and_a_bad_one_is_seen_at_once(checked):
    name, export = checked
    (honest, _, fine), (moved, summary, page) = export(), export(0.5, -0.3, 0.8)
    assert without(honest, name) == without(moved, name)
    before, after = (one["survey"]["control"][name] for one in (honest, moved))
    apart = [after[key] - before[key] for key in ("east_m", "north_m", "up_m")]
    np.testing.assert_allclose(apart, [-0.5, 0.3, -0.8], atol=2e-4)
    assert not before["note"]
    assert "standard deviations in a coordinate" in after["note"]
    (said,) = [line for line in summary["warnings"] if "check point" in line]
    assert said == f"check point {name} {after['note']}"
    assert moved["warnings"] == [said]
    row = f'<tr class="warn"><th scope="row">{name}</th>'
    assert row in page
    assert row not in fine
    assert "1 check point: too few for a statement by ASPRS (30)" in page
    assert moved["errors"]["check"]["rmse_m"]["up"] == pytest.approx(abs(after["up_m"]), rel=1e-12)


def test_a_bad_control_point_is_left_out_named_and_not_counted(rows, placed):
    name = rows[0].split()[6]
    lines = [f"{float(row.split()[0]) + 40} {row.split(' ', 1)[1]}"
             if row.endswith(name) else row for row in rows]  # fmt: skip
    _, out = placed(lines)
    found = strict(out)
    bad = found["survey"]["control"][name]
    assert [bad["used"], bad["check"]] == [False, False]
    assert bad["note"].startswith("contradicts the others: ")
    assert bad["east_m"] == pytest.approx(-40.0, abs=0.5)
    assert found["errors"]["control"]["points"] == len(found["survey"]["control"]) - 1
    assert {*found["errors"]} == {"control"}
    assert found["errors"]["control"]["rmse_m"]["3d"] < 0.3
    assert f'<tr class="warn"><th scope="row">{name}</th>' in (out / "accuracy.html").read_text()


def test_a_point_without_depth_is_listed_without_numbers(rows, placed):
    _, out = placed(
        [*rows, "455800 5429300 115 1 1 0 <sky> check"]
    )  # beyond what the right one sees
    sky = strict(out)["survey"]["control"]["<sky>"]
    assert (sky["east_m"], sky["sigma_m"]) == (None, None)
    assert sky["note"] == "has no depth where it is seen: left out"
    assert sky["images"] == ["0"]
    assert "<sky>" not in (out / "accuracy.html").read_text()


def test_the_report_is_what_a_script_that_shares_no_code_finds(rows, placed, small_demo):
    lines = [f"{row} check" if row.split()[6] == rows[-1].split()[6] else row for row in rows]
    _, out = placed(lines)
    script = [sys.executable, "-I", Path(__file__).with_name("accuracy_by_hand.py")]
    words = (out, out.parent / "gcp_list.txt", small_demo)
    done = subprocess.run([*script, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"triangulated [1-9]", done.stdout)


def test_positions_along_the_drive_are_no_check_and_the_report_says_so(small_demo, tmp_path):
    path = np.loadtxt(small_demo / "trajectory_tum.txt")
    T = np.array(summary_of(small_demo)["T_map_world"])
    places = apply(T_SURVEY_TRUE @ np.linalg.inv(make_transform(AXES_MAP_WORLD, np.zeros(3))) @ T,
                   path[:, 1:4])  # fmt: skip
    places += np.random.default_rng(3).normal(0.0, 0.02, places.shape)
    np.savetxt(tmp_path / "gnss.txt", np.column_stack([path[:, 0], places, [0.02] * len(path)]))
    words = ("--georeference", tmp_path / "gnss.txt", "--crs", HEAD, "--out", tmp_path / "out")
    done = run("export", small_demo, "--to", "laz", *words)
    assert done.code == 0, done.err
    found = strict(tmp_path / "out")
    assert {*found["errors"]} == {"path"}
    assert found["statement"].startswith("No check points: nothing independent")
    assert found["errors"]["path"]["points"] == len(path)
    assert 0.01 < found["errors"]["path"]["rmse_m"]["3d"] < 0.06
    assert found["errors"]["path"]["rmse_m"]["3d"] == pytest.approx(found["survey"]["misfit_rms_m"])
    page = (tmp_path / "out/accuracy.html").read_text()
    assert "Path, RMSE horizontal" in page
    assert "No warnings" not in page  # nothing has checked the map
    assert "a misfit, no check" in page
    assert "Check points" not in page
    assert "http" not in page.replace("http-equiv", "")


def test_ground_and_rig_are_those_of_the_street(rows, placed, small_demo):
    _, out = placed(rows)
    found, camera = strict(out), demo_source(run_settings(small_demo)).calibration
    (drive,) = found["drives"]
    assert drive["focal_px"] == pytest.approx(camera.focal_px)
    assert drive["baseline_m"] == pytest.approx(camera.baseline_m)
    assert drive["frames"] == drive["frames_placed"] == summary_of(small_demo)["frames"]
    gsd, frames = found["spreads"]["gsd_m"], found["spreads"]["frames"]
    # From just below the car to as far as rays are kept, 30 m, from 1.6 m above the ground.
    farthest_m = np.sqrt(30.0**3 / 1.0) / camera.focal_px
    assert 1.0 / camera.focal_px < gsd["p5"] <= gsd["median"] <= gsd["p95"] < farthest_m
    assert 1 <= frames["p5"] <= frames["median"] <= drive["frames"]
    assert 0.0 < found["spreads"]["keyframe_overlap"]["median"] <= 1.0
    assert found["spreads"]["sigma_m"]["median"] >= found["surveyed_m"] / 3

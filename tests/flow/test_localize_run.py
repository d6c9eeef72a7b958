"""`recon localize` writes where a drive is, leaves the map alone, and refuses in one line."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from recon.io.trajectory import read_tum
from recon.street.settings import StreetScene
from tests.flow.runs import all_files, summary_of
from tests.hostile.refusals import assert_refused, run
from tests.scenery.film import RIG, Film, film
from tests.scenery.kitti import write_kitti


@pytest.fixture(scope="module")
def drive(street_film: Film, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    write_kitti(street_film, folder)
    (folder / "empty").mkdir()
    return folder


@pytest.fixture(scope="module")
def mapped(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the even frames, at known poses; with a damaged copy of the map."""
    out = tmp_path_factory.mktemp("map") / "run"
    words = ("--stride", "2", "--poses", drive / "poses.txt", "--no-mesh", "--quiet")
    done = run("map", drive, *words, "--out", out)
    assert done.code == 0, done.err
    content = bytearray((out / "map" / "map.recon").read_bytes())
    for place in range(len(content) // 3, len(content), 4096):
        content[place] ^= 255
    (out.parent / "damaged.recon").write_bytes(content)
    return out


def test_a_run_leaves_path_states_summary_and_report_and_the_map_as_it_was(
    drive: Path, mapped: Path, tmp_path: Path
) -> None:
    before, out = all_files(mapped), tmp_path / "found"
    done = run("localize", drive, "--map", mapped, "--start", "1", "--stride", "2", "-o", out)
    assert done.code == 0, done.err
    assert all_files(mapped) == before
    summary = summary_of(out)
    states = list(csv.DictReader((out / "states.csv").open()))
    tracked = [row for row in states if row["state"] == "tracking"]
    assert summary["frames"] == len(states) == 6
    assert summary["frames_tracking"] == len(tracked) >= 5
    assert summary["first_fix_frame"] == int(tracked[0]["frame"]) <= 1
    path = read_tum(out / "trajectory_tum.txt")
    assert len(path) == len(read_tum(out / "trajectory_map_base_tum.txt")) == len(tracked)
    place = [float(tracked[0][axis]) for axis in ("x_m", "y_m", "z_m")]
    assert place == pytest.approx(path.positions_m[0], abs=1e-6)
    assert float(tracked[0]["sigma_x_m"]) > 0
    assert float(tracked[0]["cov_x_x"]) == pytest.approx(float(tracked[0]["sigma_x_m"]) ** 2)
    assert "In the map" in (out / "report.html").read_text()


def test_the_map_file_alone_will_do(drive: Path, mapped: Path, tmp_path: Path) -> None:
    words = ("--map", mapped / "map" / "map.recon", "--json", "--end", "4", "--out", tmp_path)
    assert run("localize", drive, *words).code == 0
    assert summary_of(tmp_path)["frames_tracking"] >= 3


def test_a_drive_elsewhere_ends_well_with_a_warning_and_no_pose(
    mapped: Path, tmp_path: Path
) -> None:
    write_kitti(film(StreetScene(frames=3, seed=7, **RIG)), tmp_path / "other")
    done = run("localize", tmp_path / "other", "--map", mapped, "--out", tmp_path / "found")
    assert done.code == 0
    assert "not found in the map" in done.err
    summary = summary_of(tmp_path / "found")
    assert (summary["frames_tracking"], summary["first_fix_frame"]) == (0, None)
    assert (tmp_path / "found" / "trajectory_tum.txt").read_text() == ""


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("{drive} --map missing", "missing"),
        ("{drive} --map {drive}", "map.recon"),
        ("{drive} --map {drive}/calib.txt", "not a map of recon"),
        ("{drive} --map {map} --start 1,2", "--start"),
        ("{drive} --map {map} --start here", "--start"),
        ("{drive} --map {map} --start nan,0,0", "--start"),
        ("{drive} --map {map} --start 900,0,0", "near the start pose"),
        ("{drive} --map {map} --out {map}", "would replace"),
        ("{drive} --map {map} --start 500", "500"),
        ("{drive}/empty --map {map}", "empty"),
        ("{drive} --map {map}/../damaged.recon --end 4", "damaged.recon"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    drive: Path, mapped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    words: str, said: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    done = run("localize", *words.format(drive=drive, map=mapped).split(), "--quiet")
    assert_refused(done, said)
    assert list(tmp_path.iterdir()) == []

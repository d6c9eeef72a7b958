"""`recon localize` writes where a drive is, leaves the map alone, and refuses in one line."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from recon.cli import app
from recon.io.trajectory import read_tum
from recon.street.settings import StreetScene
from tests.scenery.film import RIG, Film, film
from tests.scenery.kitti import write_kitti


def _run(*words: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(word) for word in words])
    return done.exit_code, done.output


@pytest.fixture(scope="module")
def drive(street_film: Film, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    write_kitti(street_film, folder)
    return folder


@pytest.fixture(scope="module")
def mapped(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the even frames, at known poses."""
    out = tmp_path_factory.mktemp("map") / "run"
    code, text = _run(
        *("map", drive, "--stride", 2, "--poses", drive / "poses.txt", "--no-mesh", "--quiet"),
        *("--out", out),
    )
    assert code == 0, text
    return out


def _hashes(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_a_run_leaves_path_states_summary_and_report_and_the_map_as_it_was(
    drive: Path, mapped: Path, tmp_path: Path
) -> None:
    before = _hashes(mapped)
    out = tmp_path / "found"

    code, text = _run("localize", drive, "--map", mapped, "--start", 1, "--stride", 2, "-o", out)

    assert code == 0, text
    assert _hashes(mapped) == before
    summary = json.loads((out / "summary.json").read_text())
    states = list(csv.DictReader((out / "states.csv").open()))
    tracked = [row for row in states if row["state"] == "tracking"]
    assert summary["frames"] == len(states) == 6
    assert summary["frames_tracking"] == len(tracked) >= 5
    assert summary["first_fix_frame"] == int(tracked[0]["frame"]) <= 1
    path = read_tum(out / "trajectory_tum.txt")
    assert len(path) == len(read_tum(out / "trajectory_map_base_tum.txt")) == len(tracked)
    assert [float(tracked[0][axis]) for axis in ("x_m", "y_m", "z_m")] == pytest.approx(
        path.positions_m[0], abs=1e-6
    )
    assert float(tracked[0]["sigma_x_m"]) > 0
    assert float(tracked[0]["cov_x_x"]) == pytest.approx(float(tracked[0]["sigma_x_m"]) ** 2)
    assert "In the map" in (out / "report.html").read_text()


def test_the_map_file_alone_will_do(drive: Path, mapped: Path, tmp_path: Path) -> None:
    found = tmp_path / "found"
    code, text = _run(
        *("localize", drive, "--map", mapped / "map" / "map.recon", "--json", "--end", 4),
        *("--out", found),
    )

    assert code == 0, text
    assert json.loads((found / "summary.json").read_text())["frames_tracking"] >= 3


def test_a_drive_elsewhere_ends_well_with_a_warning_and_no_pose(
    mapped: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    write_kitti(film(StreetScene(frames=3, seed=7, **RIG)), other)

    code, text = _run("localize", other, "--map", mapped, "--out", tmp_path / "found")

    summary = json.loads((tmp_path / "found" / "summary.json").read_text())
    assert code == 0
    assert "not found in the map" in text
    assert (summary["frames_tracking"], summary["first_fix_frame"]) == (0, None)
    assert (tmp_path / "found" / "trajectory_tum.txt").read_text() == ""


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--map", "{tmp}/missing"], "missing"),
        (["--map", "{drive}"], "map.recon"),
        (["--map", "{drive}/calib.txt"], "not a map of recon"),
        (["--map", "{map}", "--start", "1,2"], "--start"),
        (["--map", "{map}", "--start", "here"], "--start"),
        (["--map", "{map}", "--start", "nan,0,0"], "--start"),
        (["--map", "{map}", "--start", "900,0,0"], "near the start pose"),
        (["--map", "{map}", "--out", "{map}"], "would replace"),
        (["--map", "{map}", "--start", "500"], "500"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    drive: Path, mapped: Path, tmp_path: Path, options: list[str], said: str
) -> None:
    words = [word.format(tmp=tmp_path, drive=drive, map=mapped) for word in options]
    where = [] if "--out" in words else ["--out", str(tmp_path / "found")]

    code, text = _run("localize", drive, *words, *where, "--quiet")

    assert code == 1
    assert text.count("\n") == 1
    assert text.startswith("error: ")
    assert said in text
    assert not (tmp_path / "found").exists()


def test_a_damaged_map_is_refused_in_one_line(drive: Path, mapped: Path, tmp_path: Path) -> None:
    content = bytearray((mapped / "map" / "map.recon").read_bytes())
    for place in range(len(content) // 3, len(content), 4096):
        content[place] ^= 255
    (tmp_path / "map.recon").write_bytes(content)

    code, text = _run(
        *("localize", drive, "--map", tmp_path / "map.recon", "--out", tmp_path / "found"),
        *("--end", 4, "--quiet"),
    )

    assert code == 1
    assert text.count("\n") == 1
    assert not (tmp_path / "found").exists()


def test_an_empty_folder_is_no_drive(mapped: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()

    code, text = _run("localize", tmp_path / "empty", "--map", mapped, "--out", tmp_path / "found")

    assert code == 1
    assert text.count("\n") == 1

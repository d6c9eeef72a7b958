"""What `recon diff` writes, checked from its files by a script that shares no code with it."""

import csv
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.commands.diff import run_diff
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from tests.flow.runs import summary_of
from tests.scenery.year import FENCE_GOES, WeekDrive, fence, hoarding, parked_cars

WEEKS = (0, 26)
FRAMES = 14
SMALL = {"frames": FRAMES, "width_px": 256, "height_px": 104, "focal_px": 144.0}
#: Cars in view of both drives, of whose places one was empty on the other day.
SURE = {((4, 0, 3), "went"), ((5, 0, 6), "came")}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def compared(tmp_path_factory) -> Path:
    """A folder with the runs of two weeks, ``changes`` between them, and ``truth.json``."""
    folder = tmp_path_factory.mktemp("weeks")
    drives = [WeekDrive(week, **SMALL) for week in WEEKS]
    # Cars that are near make one of the drives a smaller scene than the other.
    config = load_config(None, ["scene.scale=1"])
    for drive in drives:
        run_map(drive, config, MapOptions(out=folder / drive.name, mesh=False, audit=False))
    run_diff(*(folder / drive.name for drive in drives), MapOptions("diff", folder / "changes"))
    camera = drives[0].calibration
    sizes = ("focal_px", "cx_px", "cy_px", "width_px", "height_px")
    truth = {
        "boxes": [*_true_boxes()],
        "T_street_world": [drive.world.T_street_camera[0].tolist() for drive in drives],
        "camera": {name: getattr(camera, name) for name in sizes},
        "names": [drive.name for drive in drives],
        "pose_error_m": 0.1,
    }
    (folder / "truth.json").write_text(json.dumps(truth))
    return folder


def _true_boxes():
    """Yield what stood in the street in one of the weeks only."""
    before, after = ({car.name: car.box_m for car in parked_cars(week)} for week in WEEKS)
    for name, (low, high) in (before | after).items():
        if (name in before) != (name in after):
            change = "went" if name in before else "came"
            yield _box(change, low, high, sure=(name, change) in SURE)
    assert WEEKS[0] < FENCE_GOES <= WEEKS[1]
    for change, soup in (("went", fence()), ("came", hoarding())):
        corners = soup.vertices.reshape(-1, 3)
        yield _box(change, corners.min(axis=0), corners.max(axis=0), sure=False)


def _box(change: str, low: np.ndarray, high: np.ndarray, *, sure: bool) -> dict[str, object]:
    box = {"low_m": low.tolist(), "high_m": high.tolist()}
    return {"change": change, **box, "must_be_found": sure}


def by_hand(folder: Path, changes: Path) -> subprocess.CompletedProcess[str]:
    script = [sys.executable, "-I", Path(__file__).with_name("changes_by_hand.py")]
    runs = [folder / WeekDrive(week).name for week in WEEKS]
    words = (changes, *runs, folder / "truth.json")
    return subprocess.run([*script, *words], capture_output=True, text=True, check=False)


def test_the_changes_are_what_a_script_that_shares_no_code_finds(compared):
    done = by_hand(compared, compared / "changes")
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"checked [2-9] objects", done.stdout)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("height_m", 1.02, "height"),
        ("length_m", 1.02, "area of its box"),
        ("heading_deg", 1.3, "out of its box"),
        ("volume_m3", 1.02, "volume"),
        ("volume_sigma_m3", 0.2, "less than its border"),
        ("volume_sigma_m3", 30.0, "heights with"),
        ("points", 2, "pieces of"),
        ("last_seen", {"frame": FRAMES}, "no frame 14"),
        ("last_seen", {"time_s": 0.0}, "time"),
        ("first_seen", {"date": "2025-01-06"}, "date"),
        ("first_seen", {"drive": "x"}, "another drive"),
    ],
)
def test_the_script_sees_a_figure_that_is_wrong(compared, tmp_path, name, value, said):
    wrong = Path(shutil.copytree(compared / "changes", tmp_path / "wrong"))
    found = summary_of(wrong)
    one = found["objects"][0]
    changed = value if isinstance(value, dict) else {name: value * one[name]}
    (one[name] if isinstance(value, dict) else one).update(changed)
    (wrong / "summary.json").write_text(json.dumps(found))
    with (wrong / "changes.csv").open(newline="") as table:
        head, *rows = csv.reader(table)
    for key, new in changed.items():
        rows[0][head.index(f"{name}_{key}" if isinstance(value, dict) else key)] = str(new)
    with (wrong / "changes.csv").open("w", newline="") as table:
        csv.writer(table).writerows([head, *rows])
    done = by_hand(compared, wrong)
    assert done.returncode == 1
    assert said in done.stderr, done.stderr


def test_the_script_sees_points_of_another_class(compared, tmp_path):
    wrong = Path(shutil.copytree(compared / "changes", tmp_path / "wrong"))
    head, end, body = (wrong / "changes.ply").read_bytes().partition(b"end_header\n")
    row = np.dtype([("xyz", "<f4", 3), ("classes", "u1", 2), ("colour", "u1", 3)])
    table = np.frombuffer(body, row).copy()
    table["classes"][:, 0][table["classes"][:, 0] == 0] = 3  # all that was the same
    (wrong / "changes.ply").write_bytes(head + end + table.tobytes())
    assert "not compared, before" in by_hand(compared, wrong).stderr

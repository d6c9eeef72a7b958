"""Drives are merged, added to a run and taken out of it, whole or not at all."""

import shutil
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import yaml

from recon.commands.config import load_config
from recon.commands.export import run_occupancy
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.commands.merge import run_map_into, run_merge, run_remove
from recon.core.errors import FormatError
from recon.io.trajectory import read_trajectory
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.map import Map
from recon.map.sessions.measured import Survey
from recon.sources.source import SourcePart
from recon.street.settings import StreetScene
from tests.flow.runs import all_files, keep_turned_rig, summary_of
from tests.hostile import refusals
from tests.scenery.film import RIG, Film, film

FIRST, FRAMES = 4, 11
OPTIONS = MapOptions(mesh=False, audit=False)


@cache
def street(seed: int, frames: int) -> Film:
    return film(StreetScene(frames=frames, seed=seed, **RIG))


def part(first: int, frames: int = FRAMES) -> SourcePart:
    # A street of its own length, whose far end looks otherwise: no two drives share every pixel.
    return SourcePart(street(2, first + FRAMES), first, first + frames)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs of two drives that overlap; a third one is elsewhere. They must not be changed."""
    folder = tmp_path_factory.mktemp("runs")
    drives = {"first": part(0), "second": part(FIRST), "elsewhere": street(9, 5)}
    for name, drive in drives.items():
        run_map(drive, load_config(), MapOptions(out=folder / name, mesh=False, audit=False))
    return folder


@pytest.fixture(scope="module")
def merged(runs):
    options = MapOptions("merge", runs / "merged", mesh=False, changes=True)
    run_merge([runs / name for name in ("first", "second", "elsewhere")], None, options)
    return runs / "merged"


@pytest.fixture
def run(runs, tmp_path):
    return Path(shutil.copytree(runs / "first", tmp_path / "run"))


def test_drives_that_share_places_are_linked_and_others_stay_apart(merged):
    found = summary_of(merged)
    assert [drive["linked"] for drive in found["sessions"]] == [True, True, False]
    assert found["links"]["pairs"].keys() == {"0-1"}
    assert found["links"]["count"] >= 3
    assert found["frames"] == 2 * FRAMES  # those of the drives that are linked
    assert any("session 2 (film)" in warning for warning in found["warnings"])
    true = street(2, FIRST + FRAMES).trajectory
    path = read_trajectory(merged / "sessions/1/trajectory_tum.txt")
    off_m = np.linalg.norm(path.positions_m - true.positions_m[FIRST:], axis=1)
    assert off_m.max() < 0.3
    assert not (merged / "sessions/2").exists()


def test_a_report_says_what_changed_where_it_is_asked_for(merged, run):
    assert summary_of(merged)["changes"] == {"came": 0, "went": 0}  # of one street, at once
    assert "What came and went" in (merged / "report.html").read_text(encoding="utf-8")
    assert "changes" not in summary_of(run)


def test_one_run_is_held_at_measured_positions(runs, tmp_path):
    before = read_trajectory(runs / "first/trajectory_tum.txt")
    longer_m = 1.01 * before.positions_m @ AXES_MAP_WORLD.T
    np.savetxt(tmp_path / "gnss.txt", np.column_stack([before.timestamps_s, longer_m]))
    out, survey = tmp_path / "held", Survey(tmp_path / "gnss.txt")
    found = run_merge(
        [runs / "first"], None, MapOptions("merge", out, mesh=False), survey
    ).to_json()
    assert found["sessions"][0]["positions"] == FRAMES
    assert found["positions_misfit_rms_m"] < 0.03
    held = read_trajectory(out / "sessions/0/trajectory_tum.txt")
    assert 1.005 < held.path_length_m / before.path_length_m < 1.012
    page = (out / "report.html").read_text()
    assert "Map of 1 drive" in page
    assert "From measured positions" in page


def test_the_folder_of_a_merged_map_is_a_run_like_others(merged, tmp_path):
    for name in ("map/cloud.ply", "map/removed.ply", "map/octomap.bt", "report.html"):
        assert (merged / name).is_file()
    run_occupancy(merged, out=tmp_path / "again")
    grids = [(folder / "map/grid.pgm").read_bytes() for folder in (merged, tmp_path / "again")]
    assert grids[0] == grids[1]
    with Map.open(merged) as map_:
        assert [session.number for session in map_.linked] == [0, 1]
        # One link of repeated windows contradicts all others.
        assert [link.kept for link in map_.links].count(False) <= 1
        assert sum(len(tile.cloud) for tile in map_.tiles()) > 1000


def test_a_drive_is_added_to_a_run_and_taken_out_again(run, runs):
    (run / "notes.txt").write_text("mine")
    before = all_files(run.parent)
    with pytest.raises(FormatError, match=r"^film 0 to 10: the map has this"):
        run_map_into(run, part(0), None, OPTIONS)
    assert all_files(run.parent) == before
    added = run_map_into(run, part(FIRST), None, OPTIONS).to_json()
    assert [drive["linked"] for drive in added["sessions"]] == [True, True]
    assert summary_of(run)["sessions"] == added["sessions"]
    run_remove(run, 1, None, OPTIONS)
    assert [drive["number"] for drive in summary_of(run)["sessions"]] == [0]
    for name in ("map/grid.pgm", "map/octomap.ot"):
        assert (run / name).read_bytes() == (runs / "first" / name).read_bytes()
    assert (run / "notes.txt").read_text() == "mine"
    assert [p.name for p in run.parent.iterdir()] == [run.name]


def test_a_drive_that_is_added_begins_with_the_rig_of_the_last_one(run):
    turned = keep_turned_rig(run)
    added = run_map_into(run, part(FIRST), None, OPTIONS).to_json()
    assert [drive["rig"]["refined"] for drive in added["sessions"]] == [True, True]
    assert [drive["rays_kept"] for drive in added["sessions"]] == [1.0, 1.0]  # of two, both
    assert [drive["date"] for drive in added["sessions"]] == ["", ""]  # stamps begin at 0
    length_m = sum(drive["length_m"] for drive in added["sessions"])
    size = (run / "map/map.recon").stat().st_size
    assert added["map_mb_per_km"] == pytest.approx(1e-3 * size / length_m, rel=0.02)
    assert (run / "rig.yaml").is_file()
    with Map.open(run) as map_:
        found = map_.session(1).rig.calibration
    np.testing.assert_array_equal(found.T_right_left, turned.T_right_left)


def test_a_drive_is_taken_out_of_a_map_of_chosen_frames(merged, tmp_path):
    run = Path(shutil.copytree(merged, tmp_path / "run"))
    chosen = load_config(run / "config.yaml", [f"source.end={FRAMES}"]).model_dump(mode="json")
    (run / "config.yaml").write_text(yaml.safe_dump(chosen))
    done = refusals.run("map", "--into", run, "--remove", "2", "--no-mesh")
    assert done.code == 0, done.err
    found = summary_of(run)
    assert [drive["number"] for drive in found["sessions"]] == [0, 1]
    assert [(drive["number"], drive["name"]) for drive in found["forgotten"]] == [(2, "film")]


@pytest.mark.parametrize("at", ["recon.run.directory.exchange", "recon.commands.merge.place_map"])
def test_what_fails_before_the_end_leaves_the_run_as_it_was(run, at):
    before, short = all_files(run.parent), part(FIRST, frames=4)
    with patch(at, side_effect=KeyboardInterrupt), pytest.raises(KeyboardInterrupt):
        run_map_into(run, short, None, OPTIONS)
    assert all_files(run.parent) == before
    run_map_into(run, short, None, OPTIONS)  # and it can be tried again
    assert len(summary_of(run)["sessions"]) == 2


def _refused(*words: str | Path) -> str:
    done = refusals.run(*words)
    assert done.code in (1, 2), done.err
    assert "Traceback" not in done.err
    return " ".join(done.err.replace("\u2502", " ").split())


@pytest.mark.parametrize(("second", "message"), [
    ("missing", "does not contain a finished run"),
    ("first", "the same run twice"),
    ("copy", "has this drive already"),
    ("pair", "the run made no map"),
    ("coarse", "voxels of different sizes (got 0.2 m, expected 0.1 m); map it again with --set"),
    ("scaled", "(got 0.2 m, expected 0.1 m); map it again with --set scene.scale=1, or into"),
    ("newer", "newer version of recon"),
    ("odd", "odd/map/map.recon: content cannot be read (got KeyError: 'grain')"),
])  # fmt: skip
def test_a_wrong_merge_is_one_line(runs, tmp_path, second, message):
    other = runs / "first" if second == "first" else tmp_path / second
    if second not in ("missing", "first"):
        shutil.copytree(runs / ("first" if second == "copy" else "second"), other)
    if second == "pair":
        (other / "run.json").write_text('{"command": "pair"}')
    elif second in ("coarse", "scaled", "newer", "odd"):
        with Map.open(other, read_only=False) as map_:
            if second in ("coarse", "scaled"):
                info = map_.store.read("session", 0)
                info["config"]["fusion"]["voxel_m"] = 0.2
                info["config"]["scene"]["scale"] = {"coarse": 1.0, "scaled": 2.0}[second]
                map_.store.put("session", 0, info)
            elif second == "newer":
                map_.store._database.execute("PRAGMA user_version = 99")
            else:
                map_.store.put("rays", (0, 0), {})
            map_.commit()
    told = _refused("merge", runs / "first", other, "--out", tmp_path / "out", "--no-mesh")
    assert message in told
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("arguments", "message"), [
    ("merge RUN", "nothing to merge"),
    ("merge RUN OTHER --out OTHER", "would replace the run"),
    ("map x --into RUN --resume OTHER", "--into changes RUN"),
    ("map x --into RUN --out OTHER", "--into changes RUN"),
    ("map x --into RUN --remove 0", "maps no SOURCE"),
    ("map --remove 0", "--into"),
    ("map x --changes", "--into RUN"),
    ("map --into RUN --remove 5", "no such session"),
    ("map --into RUN --remove 0", "only this session"),
    ("map --into RUN --remove 0 --end 3", "no effect here"),
    ("map x --into nowhere", "does not contain a finished run"),
])  # fmt: skip
def test_options_that_contradict_are_one_line(runs, arguments, message):
    places = {"RUN": str(runs / "first"), "OTHER": str(runs / "second")}
    before = all_files(runs / "first")
    assert message in _refused(*(places.get(part, part) for part in arguments.split()))
    assert all_files(runs / "first") == before

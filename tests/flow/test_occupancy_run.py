"""`recon occupancy`: other maps of a drive, from the data that its run kept."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recon.commands.config import run_settings
from recon.commands.evaluate import run_evaluate_occupancy
from recon.commands.export import run_occupancy
from recon.core.errors import FormatError, OutputError, ReconError, SettingsError
from recon.core.values import OCCUPIED
from recon.io.models.nav2 import read_nav2
from recon.io.models.octomap import read_octomap
from recon.map.store.records import Store
from recon.stereo import frame
from tests.hostile.refusals import assert_refused, run


def _remake(run: Path, out: Path, *overrides: str, **changes: Any) -> dict[str, Any]:
    return run_occupancy(run, run_settings(run, None, overrides), out=out, **changes)


def _copy(run: Path, folder: Path) -> Path:
    return shutil.copytree(run, folder / "copy")


def test_the_same_settings_give_the_same_map(small_demo: Path, tmp_path: Path) -> None:
    summary = _remake(small_demo, tmp_path / "same")
    for name in ("map/grid.pgm", "map/grid.yaml", "map/octomap.bt", "config.yaml"):
        assert (tmp_path / "same" / name).read_bytes() == (small_demo / name).read_bytes()
    ours, theirs = (read_octomap(f / "map/octomap.ot") for f in (small_demo, tmp_path / "same"))
    np.testing.assert_array_equal(ours.keys, theirs.keys)
    np.testing.assert_array_equal(ours.log_odds, theirs.log_odds)
    assert summary["frames"] == 12
    assert summary["voxels"] > 10_000


def test_nothing_is_matched(
    small_demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(frame, "make_matcher")
    assert _remake(small_demo, tmp_path / "out")["occupied_cells"] > 0


def test_another_height_band_changes_the_grid_alone(small_demo: Path, tmp_path: Path) -> None:
    out = tmp_path / "high"
    _remake(small_demo, out, "grid.min_height_m=2.2", "grid.max_height_m=6")
    same = "map/octomap.bt"
    assert (out / same).read_bytes() == (small_demo / same).read_bytes()
    low, high = (read_nav2(f / "map/grid.yaml") for f in (small_demo, out))
    assert low.cells.shape == high.cells.shape
    parked = (low.cells == OCCUPIED) & (high.cells != OCCUPIED)
    assert parked.sum() > 10  # cars are lower than the band


# Few small images: what was measured is 0.96 and 0.53, 0.86 and 0.91, 0.91 and 0.96. At 0.1 m
# neighbouring rays end farther apart than voxels, so that recall is low.
@pytest.mark.parametrize(
    ("resolution_m", "precision", "recall"), [(0.1, 0.9, 0.4), (0.25, 0.8, 0.85), (0.5, 0.85, 0.9)]
)
def test_another_resolution_is_right_too(
    small_demo: Path, tmp_path: Path, resolution_m: float, precision: float, recall: float
) -> None:
    out = tmp_path / "out"
    summary = _remake(small_demo, out, f"occupancy.resolution_m={resolution_m}")
    assert summary["resolution_m"] == resolution_m
    grid, voxels = read_nav2(out / "map/grid.yaml"), read_octomap(out / "map/octomap.ot")
    assert grid.resolution_m == voxels.resolution_m == resolution_m
    found = run_evaluate_occupancy(out).metrics
    assert found.resolution_m == resolution_m
    assert found.voxels.precision > precision
    assert found.voxels.recall > recall


def test_a_shorter_range_knows_less(small_demo: Path, tmp_path: Path) -> None:
    near = _remake(small_demo, tmp_path / "near", "occupancy.max_range_m=12")
    assert near["voxels"] < _remake(small_demo, tmp_path / "far")["voxels"] / 2


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        (
            "occupancy.resolution_m=0.09",
            r"too coarse for these voxels \(got 0\.09 m, expected at least 0\.1 m",
        ),
        ("occupancy.max_range_m=26", r"that far \(got 26 m, expected at most 25 m"),
        ("matching.matcher=sgm", "has no effect here.*matching"),
        ("fusion.voxel_m=0.2", "has no effect here.*fusion"),
        ("grid.min_height_m=7", "height band"),
        ("grid.heigth=7", "heigth"),
    ],
)
def test_what_the_rays_do_not_hold_is_refused(
    small_demo: Path, tmp_path: Path, setting: str, words: str
) -> None:
    with pytest.raises(ReconError, match=words):
        _remake(small_demo, tmp_path / "out", setting)
    assert not (tmp_path / "out").exists()


def _alter(run: Path, folder: Path, change: Callable[[Store], None]) -> Path:
    """A copy of a run whose map is changed."""
    copy = _copy(run, folder)
    with Store.open(copy / "map/map.recon") as store:
        change(store)
        store.commit()
    return copy


def test_a_run_that_kept_no_rays_is_reported(small_demo: Path, tmp_path: Path) -> None:
    copy = _alter(small_demo, tmp_path, lambda store: store.delete("rays"))
    with pytest.raises(FormatError, match=r"kept no rays.*keep_rays=true"):
        _remake(copy, tmp_path / "out")


def test_damaged_rays_leave_nothing_behind(small_demo: Path, tmp_path: Path) -> None:
    def damage(store: Store) -> None:
        rays = store.read("rays", (0, 3), most_bytes=1 << 30)
        store.put("rays", (0, 3), {**rays, "count": rays["count"][:-1]})

    with pytest.raises(ReconError, match="count"):
        _remake(_alter(small_demo, tmp_path, damage), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_rays_and_poses_must_be_of_the_same_frames(small_demo: Path, tmp_path: Path) -> None:
    copy = _alter(small_demo, tmp_path, lambda store: store.delete("rays", (0, 11)))
    with pytest.raises(FormatError, match="11 and 12"):
        _remake(copy, tmp_path / "out")


def test_a_folder_that_is_no_run_is_reported(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="not contain a finished run"):
        _remake(tmp_path, tmp_path / "out")


def test_the_run_itself_and_other_files_are_never_replaced(
    small_demo: Path, tmp_path: Path
) -> None:
    with pytest.raises(SettingsError, match="replace the run"):
        _remake(small_demo, small_demo)
    (tmp_path / "diary.txt").write_text("mine")
    with pytest.raises(OutputError, match="not of a run"):
        _remake(small_demo, tmp_path)
    assert (small_demo / "trajectory_kitti.txt").is_file()


def test_the_command_prints_json_and_says_what_is_wrong(small_demo: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ("occupancy", small_demo, "--out", out)
    good = run(*command, "--json", "--resolution", "0.5", "--min-height", "0.5")
    assert good.code == 0, good.err
    assert json.loads(good.out) == json.loads((out / "summary.json").read_text())
    record = json.loads((out / "run.json").read_text())
    assert record["command"] == "occupancy"
    assert record["mapped_by"] == "demo"
    assert set(record["files"]) == {
        p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()
    }
    bad = run(*command, "--resolution", "0.01")
    assert_refused(bad)
    assert bad.err.count("\n") == 1
    # The earlier result stays.
    assert json.loads((out / "summary.json").read_text())["resolution_m"] == 0.5

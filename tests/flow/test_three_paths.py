"""Errors of paths by how they differ: recovered where independent, doubted where they are not."""

import json
import sys
from functools import cache
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from recon.core.geometry.se3 import as_transform
from recon.core.values import Trajectory
from recon.evaluation.trajectory import Segments, segments_of
from recon.io.trajectory import write_kitti_poses
from tests.flow.runs import ROOT
from tests.scenery.kitti import street_drive

FRAMES = 300


@pytest.fixture(scope="module")
def three():
    """The benchmark as a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "benchmarks")
        import three_paths

        yield three_paths


def exact(frames: int = FRAMES) -> Trajectory:
    """A winding path, 1 m a frame."""
    turns = 0.01 * np.sin(np.arange(frames - 1) / 30)
    return walked([as_transform(np.array([0, 0, 1.0, 0, turn, 0])) for turn in turns])


def walked(steps) -> Trajectory:
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step)
    return Trajectory(np.stack(poses), np.arange(float(len(poses))))


def noise(seed: int, n: int, m: float, deg: float) -> np.ndarray:
    sigmas = np.repeat([m, np.radians(deg)], 3)
    return as_transform(np.random.default_rng(seed).normal(0, 1, (n, 6)) * sigmas)


def jittered(path: Trajectory, seed: int) -> Trajectory:
    """Each pose off by itself, as a receiver has it."""
    return Trajectory(path.T_world_camera @ noise(seed, len(path), 0.02, 0.05), path.timestamps_s)


def drifted(path: Trajectory, seed: int, m: float, deg=0.0, scale=1.0) -> Trajectory:
    """Each step off, as odometry has it."""
    steps = np.linalg.inv(path.T_world_camera[:-1]) @ path.T_world_camera[1:]
    steps[:, :3, 3] *= scale
    return walked(steps @ noise(seed, len(steps), m, deg))


def true_error(three, path: Trajectory, segments: Segments, component="translation") -> float:
    off = three.differences([exact(), path], segments)[1][:, three.COMPONENTS[component]]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


@pytest.mark.parametrize("programs", [2, 3])
def test_independent_errors_are_recovered(three, programs):
    held = []
    for seed in range(0, 50, 10):
        paths = {"truth": jittered(exact(), seed)}
        drifts = {f"p{n}": drifted(exact(), seed + n, 0.004 * n, 0.01 * n) for n in range(1, 4)}
        paths |= dict(list(drifts.items())[:programs])
        found = three.compared(paths)
        for length_m, component in product((5.0, 20.0), three.COMPONENTS):
            segments = segments_of(paths["truth"].distances_m, (length_m,), 1)
            one = found[f"{length_m:g}"][component]
            assert one["not_independent"] == []
            for name, path in paths.items():
                low, high = one["errors"][name]["interval"]
                held.append(low <= true_error(three, path, segments, component) <= high)
                assert high - low < 1.5 * one["differences"]["p1, p2"]["error"]
    assert np.mean(held) >= 0.93


def test_what_two_programs_share_counts_as_the_truths(three):
    road = drifted(exact(), 4, 0.008)  # seen alike by both
    paths = {
        "truth": jittered(exact(), 1),
        "ours": drifted(road, 2, 0.004),
        "theirs": drifted(road, 3, 0.004),
    }
    found = three.compared(paths)["5"]["translation"]
    segments = segments_of(paths["truth"].distances_m, (5.0,), 1)
    each = (paths["truth"], road, paths["ours"])
    own, shared, ours = (true_error(three, path, segments) for path in each)
    assert found["errors"]["truth"]["error"] == pytest.approx(np.hypot(own, shared), rel=0.15)
    assert found["errors"]["ours"]["error"] < 0.7 * ours
    assert found["not_independent"] == []  # three paths cannot tell
    four = three.compared({**paths, "other": drifted(exact(), 5, 0.004)})["5"]["translation"]
    assert four["not_independent"] == ["ours, theirs"]
    assert four["by_three"]["theirs"] == found["errors"]


def test_a_negative_square_is_not_resolved_and_not_zero(three):
    longer, shorter = (drifted(exact(), 2, 0.0, scale=scale) for scale in (1.01, 0.99))
    found = three.compared({"truth": exact(), "ours": longer, "theirs": shorter})
    error = found["10"]["along"]["errors"]["truth"]
    # Segments end behind their length: 11 m, off by 11 cm. (1 + 1 - 4) / 2
    assert error["error"] is None
    assert error["mean_square"] == pytest.approx(-(1.1**2), rel=0.02)
    assert "not resolved" in "\n".join(three.text("drive", "as it is", found))


def test_a_drive_that_holds_too_few_segments_gets_no_intervals(three):
    path = exact(25)
    found = three.compared({"truth": jittered(path, 1), "a": drifted(path, 2, 0.01), "b": path})
    assert set(found) - {"paths", "frames", "path_length_m"} == {"5", "10", "20", "t_rel"}
    errors = [found[length]["translation"]["errors"]["truth"] for length in ("5", "10")]
    assert [one["interval"] is None for one in errors] == [False, True]
    few = "10 m: 15 segments, 2 side by side: too few for intervals"
    assert few in "\n".join(three.text("drive", "as it is", found))


def test_tables_have_the_truths_share_beside_drift(three, monkeypatch):
    import results

    paths = {
        "truth": jittered(exact(), 1),
        "ours": drifted(exact(), 2, 0.004),
        "ORB-SLAM3": exact(),
    }
    truth, ran = {"as it is": three.compared(paths)}, []
    path = {"t_rel_percent": 0.7, "r_rel_deg_per_100m": 1.0, "ate_m": 0.1, "path_length_m": 9.0}
    printed = {"three_paths.py": truth, "recon map": {"trajectory": path, **path}}

    def run_here(line, folder):
        ran.append(line)
        return next((found for part, found in printed.items() if part in line), {"f_score": 0.8})

    monkeypatch.setattr(results, "run_here", run_here)
    monkeypatch.setattr(results, "run_once", cache(lambda line: run_here(line, ROOT)))
    ratio = truth["as it is"]["t_rel"]["translation"]["errors"]["truth"]["error"]
    for table in (results.TABLES["kitti-lenses"], results.TABLES["kitti-sfm"]):
        found = {key: results.output(line, ROOT) for key, line in table.commands.items()}
        ratios = {row["truth's ratio"] for row in results.rows_of(table, found).values()}
        assert ratios == {f"{ratio:.2f} %"}
    assert sum("three_paths.py" in line for line in ran) == 6  # of three drives and two rigs, once
    rows = results.rows_of(results.TABLES["three-paths"], {"street, refined (x), truth": truth})
    assert rows["street, refined, 10 m"]["segments"] == truth["as it is"]["10"]["segments"]
    assert "street, refined, 5 m" not in rows
    assert rows["street, refined, 50 m, rotation"]["truth"].endswith("°/100 m")


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return street_drive(tmp_path_factory.mktemp("street"), 14, speed_m_per_frame=0.5)


def test_a_drive_is_compared_with_the_peers_that_are_there(three, street, tmp_path, capsys):
    true = three.true_path(three.alterations(three.open_source(street))["as it is"])
    for program in ("orbslam3", "other"):
        (tmp_path / program / street.name).mkdir(parents=True)
        path = drifted(true, len(program), 0.002)
        write_kitti_poses(tmp_path / program / street.name / "as_it_is.txt", path)
    three.main([str(street), "--peers", str(tmp_path), "--json"])
    one = json.loads(capsys.readouterr().out).pop("as it is")
    assert one["paths"] == ["truth", "ours", "ORB-SLAM3", "other"]
    assert 0.0 < one["5"]["translation"]["differences"]["truth, ours"]["error"] < 5.0


def test_all_paths_are_in_the_axes_of_the_refined_rig(three, street, monkeypatch):
    altered = three.alterations(three.open_source(street))["as it is"]
    true, turn = three.true_path(altered), noise(7, 1, 0.0, 2.0)[0]

    def turned(path, _=None):
        return Trajectory(path.T_world_camera @ turn, path.timestamps_s)

    monkeypatch.setattr(three, "refine_rig", lambda *_: SimpleNamespace(poses=turned))
    monkeypatch.setattr(three, "follow", lambda *_: {"ours": None})
    monkeypatch.setattr(three, "path_of", lambda *_: turned(true))
    found = three.compared(three.paths_of(altered, {"theirs": true}, three.load_config()))
    for each in found["5"]["translation"]["differences"].values():
        assert each["error"] is None or each["error"] < 1e-6


def test_what_cannot_be_compared_is_refused_in_a_line(three, street, tmp_path):
    peers = ["--peers", str(tmp_path)]
    refused(three, [street, *peers], "no poses of another program: expected")
    refused(three, [street, *peers, "--only", "noisy"], f"{street.name}/noisy.txt")
    refused(three, [street, *peers, "--only", "sideways"], "no row 'sideways'; there are as it is,")
    refused(three, [tmp_path, *peers], str(tmp_path))
    (tmp_path / "orbslam3" / street.name).mkdir(parents=True)
    write_kitti_poses(tmp_path / "orbslam3" / street.name / "as_it_is.txt", exact(13))
    refused(three, [street, *peers], "numbers of poses and timestamps differ")
    bare = street_drive(tmp_path / "bare", 3)
    (bare / "poses.txt").unlink()
    refused(three, [bare, *peers], "has no true poses")
    standing = street_drive(tmp_path / "standing", 3, speed_m_per_frame=0.0)
    (tmp_path / "orbslam3" / standing.name).mkdir(exist_ok=True)
    write_kitti_poses(tmp_path / "orbslam3" / standing.name / "as_it_is.txt", exact(3))
    refused(three, [standing, *peers], "true path is too short (got 0")
    file = tmp_path / "orbslam3" / street.name / "as_it_is.txt"
    refused(sys.modules["altered_drives"], [street, "--peer", file], "is no folder of poses")


def refused(benchmark, words: list, expected: str) -> None:
    with pytest.raises(SystemExit) as end:
        benchmark.main([str(word) for word in words])
    assert expected in str(end.value.code)
    assert "\n" not in str(end.value.code)

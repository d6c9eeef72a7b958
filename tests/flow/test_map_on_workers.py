"""A drive mapped in pieces by workers: the run of one drive, whatever dies on the way."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from recon.map.map import Map
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetSettings
from tests.flow.test_batch import below, wait_until
from tests.flow.test_killed_runs import begun, content
from tests.hostile.refusals import assert_refused, run
from tests.scenery.kitti import write_kitti
from tests.scenery.patience import LONG_S

psutil = pytest.importorskip("psutil")
pytest.importorskip("distributed")

STREET = StreetSettings(frames=84, width_px=192, height_px=72, focal_px=110.0)
SETTINGS = ["checkpoints.every_frames=10", "submaps.length_m=8", "submaps.tile_m=25.6"]


class Runs:
    """A drive, mapped in one piece and by two workers."""

    def __init__(self, folder: Path) -> None:
        self.drive = folder / "drive"
        write_kitti(SyntheticSource(STREET), self.drive)
        self.whole, self.pieces = folder / "whole", folder / "pieces"
        for out, options in ((self.whole, []), (self.pieces, ["--workers", "2"])):
            command = [*self.command(out), *options]
            done = subprocess.run(command, capture_output=True, check=False, text=True)
            assert done.returncode == 0, done.stderr

    def command(self, out: Path) -> list[str]:
        settings = [word for text in SETTINGS for word in ("--set", text)]
        program = [sys.executable, "-m", "recon", "map", "--json", "--no-mesh"]
        return [*program, str(self.drive), "--out", str(out), *settings]

    def interrupted(self, out: Path) -> subprocess.Popen[bytes]:
        """Begin a run by two workers; returns when a piece has committed something."""
        client = subprocess.Popen(
            [*self.command(out), "--workers", "2"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        folder = out / ".partial" / ".state" / "pieces"
        wait_until(lambda: any(map(committed, folder.glob("[01]"))), client, "commit of a piece")
        return client


def committed(piece: Path) -> bool:
    if not begun(piece):
        return False
    with Map.open(piece / ".partial" / ".state" / "map.recon") as map_:
        return map_.session().state() is not None


def keys(tree: Any) -> Any:
    """The names in a summary, with those of stages left out."""
    if not isinstance(tree, dict):
        return None
    return {name: keys(value) for name, value in tree.items() if name not in ("stages", "refused")}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    return Runs(tmp_path_factory.mktemp("runs"))


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_run_has_the_form_of_one_in_one_piece(runs: Runs) -> None:
    whole, pieces = (
        json.loads((out / "summary.json").read_text()) for out in (runs.whole, runs.pieces)
    )
    assert keys(pieces) == keys(whole)
    assert set(content(runs.pieces)) == set(content(runs.whole))
    assert not (runs.pieces / ".partial").exists()
    assert pieces["frames"] == STREET.frames
    # In pictures this small, drift is mostly chance: `benchmarks/fleet.py long` compares it.
    assert all(one["trajectory"]["t_rel_percent"] < 2 for one in (whole, pieces))
    with Map.open(runs.pieces) as map_:
        assert len(map_.sessions) == 1
        assert len(map_.session()) == STREET.frames
    record = json.loads((runs.pieces / "run.json").read_text())
    assert [(one["first"], one["last"]) for one in record["pieces"]] == [(0, 42), (22, 84)]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_piece_whose_process_is_killed_goes_on_and_nothing_changes(
    runs: Runs, tmp_path: Path
) -> None:
    client = runs.interrupted(tmp_path / "out")
    below(client, "recon.run.batch.guard")[0].kill()
    _, told = client.communicate()
    assert client.returncode == 0, told
    assert content(tmp_path / "out") == content(runs.pieces)
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert sorted(one["tries"] for one in record["pieces"]) == [1, 2]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_client_that_is_killed_leaves_what_resume_goes_on_with(
    runs: Runs, tmp_path: Path
) -> None:
    client = runs.interrupted(tmp_path / "out")
    left = below(client, "recon", "spawn")
    client.kill()
    client.communicate()
    assert psutil.wait_procs(left, timeout=LONG_S)[1] == []
    done = subprocess.run(
        [sys.executable, "-m", "recon", "map", "--resume", str(tmp_path / "out"), "--json"],
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert content(tmp_path / "out") == content(runs.pieces)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    drive = tmp_path_factory.mktemp("short")
    source = SyntheticSource(StreetSettings(frames=3, width_px=128, height_px=48, focal_px=80.0))
    write_kitti(source, drive)
    lines = (f"{n} 0 0 0 0 0 0 1\n" for n in range(-1, 9))
    (drive / "prior.txt").write_text("".join(lines))
    return drive


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--workers", "2", "--poses", "DRIVE/poses.txt"], "--poses or --prior is mapped in one"),
        (["--workers", "2", "--prior", "DRIVE/prior.txt"], "--poses or --prior is mapped in one"),
        (["--workers", "2", "--set", "occupancy.keep_rays=false"], "joined by their rays"),
        (["--scheduler", "nonsense"], "nonsense: the scheduler cannot be reached"),
    ],
)
def test_what_does_not_combine_is_refused_and_nothing_is_left(
    short: Path, tmp_path: Path, words: list[str], said: str
) -> None:
    out = tmp_path / "out"
    words = [word.replace("DRIVE", str(short)) for word in words]
    assert_refused(run("map", short, "--out", out, *words), said)
    assert not out.exists()


def test_options_that_say_nothing_together_are_wrong_usage(tmp_path: Path) -> None:
    scheduler = ["--scheduler", "tcp://127.0.0.1:9"]
    for words in (["--workers", "2", *scheduler], ["--into", "run", *scheduler]):
        assert run("map", tmp_path, *words).code == 2


def test_without_dask_the_line_says_what_to_install(
    short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    words = ("map", short, "--out", tmp_path / "out", "--workers", "2")
    assert_refused(run(*words), "pip install 'recon[cluster]'")
    assert not (tmp_path / "out").exists()

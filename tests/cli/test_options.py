"""An option names its setting, and what is given on the command line is in the configuration."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from recon.cli import app
from recon.cli.drive_options import DriveOptions, StartInMap, read_start
from recon.cli.evaluate import app as evaluate
from recon.cli.options import Shared, survey_of, takes_groups
from recon.commands.config import ReconConfig, load_config
from recon.core.errors import SettingsError
from recon.core.settings import setting_names
from recon.map.localize.sequence import StartPose
from recon.map.sessions.measured import Survey

SEEN: list[ReconConfig] = []
probe = typer.Typer()


@probe.command()
@takes_groups
def see(start: StartInMap = None, *, reading: DriveOptions, shared: Shared) -> None:
    with shared.one_line_errors():
        SEEN.append(shared.settings())


@pytest.mark.parametrize(
    ("line", "settings"),
    [
        ("", {}),
        ("--set odometry.method=kiss --threads 2", {"odometry.method": "kiss"}),
        ("--start 2 --end 9 --stride 3", {"source.start": 2, "source.end": 9, "source.stride": 3}),
        ("--start 1,2,90", {}),
        ("--left 0 --right null", {"source.left": "0", "source.right": "null"}),
        ("--focal 300 --cx 0", {"source.focal_px": 300, "source.cx_px": 0}),
        ("--calib rig.yaml", {"source.calibration": "rig.yaml"}),
        ("--set matching.matcher=sad --matcher sgm", {"matching.matcher": "sgm"}),
        ("--memory-limit 1.5G", {"memory.limit_mb": 1500}),
    ],
)
def test_what_is_given_is_set(line: str, settings: dict[str, Any]) -> None:
    done = CliRunner().invoke(probe, line.split())
    assert done.exit_code == 0, done.output
    assert SEEN.pop() == load_config(None, [settings])


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("--memory-limit much", "cannot read this size"),
        ("--start 1,2", "--start"),
        ("--focal -1", "source.focal_px"),
        ("--stride 0", "source.stride"),
    ],
)
def test_what_is_no_value_of_its_setting_is_refused(line: str, words: str) -> None:
    done = CliRunner().invoke(probe, line.split())
    assert done.exit_code == 1
    assert words in done.stderr
    assert done.stderr.count("\n") == 1


def test_every_option_that_names_a_setting_names_one_that_there_is() -> None:
    commands = [one.callback for one in (*app.registered_commands, *evaluate.registered_commands)]
    options = [p for one in commands for p in inspect.signature(one or see).parameters.values()]
    marks = [mark for one in options for mark in getattr(one.annotation, "__metadata__", ())]
    named = [mark.setting for mark in marks if isinstance(getattr(mark, "setting", None), str)]
    assert len(named) > 50
    assert {*named} <= {*setting_names(ReconConfig)}


def test_a_survey_is_positions_with_an_offset_and_a_system() -> None:
    positions = Path("gnss.txt")
    assert survey_of(None, None) is None
    assert survey_of(positions, None) == Survey(positions, (0.0, 0.0, 0.0), None)
    full = survey_of(positions, "-0.4,0,1", "EPSG:25832")
    assert full == Survey(positions, (-0.4, 0.0, 1.0), "EPSG:25832")


@pytest.mark.parametrize(
    ("positions", "antenna", "crs", "where"),
    [
        (None, "0,0,1", None, "--antenna"),
        (None, None, "EPSG:25832", "--crs"),
        ("gnss.txt", "1,2", None, "--antenna"),
        ("gnss.txt", "1,2,3,4", None, "--antenna"),
        ("gnss.txt", "1,2,1e999", None, "--antenna"),
        ("gnss.txt", "here", None, "--antenna"),
    ],
)
def test_half_a_survey_is_refused(
    positions: str | None, antenna: str | None, crs: str | None, where: str
) -> None:
    with pytest.raises(SettingsError, match=where):
        survey_of(None if positions is None else Path(positions), antenna, crs)


def test_a_drive_begins_at_a_pose_or_a_frame() -> None:
    assert read_start(None) == (None, None)
    assert read_start("7") == (None, 7)
    assert read_start("12.5,-3,90") == (StartPose(12.5, -3.0, 90.0), None)
    for text in ("1.5", "1,2", "1,2,3,4", "1,2,1e999", "there"):
        with pytest.raises(SettingsError, match="--start"):
            read_start(text)

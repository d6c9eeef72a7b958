"""An option names its setting, and what is given on the command line is in the configuration."""

from __future__ import annotations

import inspect
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from recon.cli import app, evaluate
from recon.cli.drive_options import DriveOptions, StartInMap
from recon.cli.options import Shared, takes_groups
from recon.commands.config import ReconConfig, load_config
from recon.core.settings import setting_names

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
    commands = [
        one.callback for one in (*app.registered_commands, *evaluate.app.registered_commands)
    ]
    options = [p for one in commands for p in inspect.signature(one or see).parameters.values()]
    marks = [mark for one in options for mark in getattr(one.annotation, "__metadata__", ())]
    named = [mark.setting for mark in marks if isinstance(getattr(mark, "setting", None), str)]
    assert len(named) > 50
    assert {*named} <= {*setting_names(ReconConfig)}

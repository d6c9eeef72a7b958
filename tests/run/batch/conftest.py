"""A stand-in for the program."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from recon.run.batch import job as process
from tests.run.batch.jobs import STAND_IN


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    script = tmp_path / "stand_in.py"
    script.write_text(STAND_IN)
    monkeypatch.setattr(process, "_PROGRAM", (sys.executable, str(script)))

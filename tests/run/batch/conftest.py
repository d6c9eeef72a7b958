"""A stand-in for the program."""

import sys

import pytest

from recon.run.batch import job as process
from tests.run.batch.jobs import STAND_IN


@pytest.fixture(autouse=True)
def stand_in(monkeypatch):
    monkeypatch.setattr(process, "_PROGRAM", (sys.executable, "-c", STAND_IN))

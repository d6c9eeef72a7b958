"""Tests on a machine that is slow, or busy: nothing is left out, and nothing comes too late."""

import pytest

from recon.core.values import RectifiedPair
from recon.map.drive.drive import MapBehind
from recon.odometry.protocol import OdometryResult
from recon.sources import live

LONG_S = 300.0
"""How long to wait for what comes at once, unless it never does."""


def be_patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let pairs wait for poses, and poses for the map."""
    add = MapBehind.add

    def add_and_wait(self: MapBehind, registered: tuple[RectifiedPair, OdometryResult]) -> None:
        add(self, registered)
        self.wait()

    monkeypatch.setattr(live, "_WAITING", 1000)
    monkeypatch.setattr(MapBehind, "add", add_and_wait)

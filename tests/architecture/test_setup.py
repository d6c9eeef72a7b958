"""The setup script installs what a run needs, and `recon doctor` checks for the same."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from recon.commands.doctor import PACKAGES, SYSTEM_LIBRARIES
from recon.commands.kernel_samples import SAMPLES


def test_doctor_looks_for_the_libraries_that_setup_installs(root: Path) -> None:
    entry = re.compile(r"^ +(lib\S+\.so\S*?):(\S+)", re.MULTILINE)
    installed = dict(entry.findall((root / "scripts" / "setup.sh").read_text()))

    assert dict(SYSTEM_LIBRARIES) == installed


def test_doctor_looks_for_every_package_that_is_declared(pyproject: dict[str, Any]) -> None:
    declared = {re.split("[>= ]", entry)[0] for entry in pyproject["project"]["dependencies"]}
    unneeded = {"tomli"} if sys.version_info >= (3, 11) else set()

    assert set(PACKAGES) == declared - unneeded


def test_doctor_runs_a_kernel_of_each_room_that_has_some(root: Path) -> None:
    assert set(SAMPLES) == {folder.parent.name for folder in (root / "recon").glob("*/kernels")}

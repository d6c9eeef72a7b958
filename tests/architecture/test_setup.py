"""The setup script installs what a run needs, and `recon doctor` checks for the same."""

from __future__ import annotations

import re
from pathlib import Path

from recon.commands.doctor import SYSTEM_LIBRARIES


def test_doctor_looks_for_the_libraries_that_setup_installs(root: Path) -> None:
    entry = re.compile(r"^ +(lib\S+\.so\S*?):(\S+)", re.MULTILINE)
    installed = dict(entry.findall((root / "scripts" / "setup.sh").read_text()))

    assert dict(SYSTEM_LIBRARIES) == installed

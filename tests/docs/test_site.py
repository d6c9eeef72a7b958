"""The site of the pages, as `make docs` builds it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import recon
from tests.docs.blocks import ROOT


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_shows_every_public_name(tmp_path):
    """Strictly: a page that no menu has, or a link that leads nowhere, is an error."""
    command = [str(Path(sys.executable).with_name("mkdocs")), "build", "--strict"]
    done = subprocess.run(
        [*command, "--site-dir", str(tmp_path)], cwd=ROOT, capture_output=True, text=True,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "api" / "index.html").read_text()
    assert [name for name in recon.__all__ if f'id="recon.{name}"' not in page] == []
    home = (tmp_path / "index.html").read_text()
    assert 'href="getting-started/"' in home
    assert (tmp_path / "images" / "demo.jpg").is_file()

"""Fixtures shared by all tests: the real data, if available."""

import os
from functools import cache, lru_cache
from pathlib import Path

import hypothesis
import pytest
import typer.testing

from recon.sources import synthetic

# The same examples on every machine and in every run: a failure is one of the change at hand.
# A deadline would fail examples that compile, and any of them on a busy machine.
hypothesis.settings.register_profile("recon", deadline=None, derandomize=True, database=None)
# `make fuzz` chooses this one, with a seed that repeats a round.
hypothesis.settings.register_profile("fuzz", deadline=None, database=None)
hypothesis.settings.load_profile("recon")


@pytest.fixture(scope="session")
def recon_data():
    """Folder of real data; the test is skipped where ``RECON_DATA`` does not name one."""
    folder = os.environ.get("RECON_DATA")
    if not folder:
        pytest.skip("real data: the environment variable RECON_DATA is not set")
    path = Path(folder)
    if not path.is_dir():
        pytest.skip(f"real data: RECON_DATA={folder} is no folder")
    return path


@pytest.fixture(scope="session", autouse=True)
def commands_built_once():
    """Let Typer build the tree of commands once, not at each call, where it is most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typer.testing, "_get_command", cache(typer.testing._get_command))
        yield


@pytest.fixture(scope="session", autouse=True)
def streets_built_once():
    """Let sources of equal settings share their street, and what was rendered of it."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("build_street", "StreetCamera"):
            patch.setattr(synthetic, name, lru_cache(maxsize=8)(getattr(synthetic, name)))
        yield


@pytest.fixture(scope="module")
def blank_figures():
    """Leave the figures of reports blank where nobody looks at them: a page takes seconds."""
    from tests.scenery.figures import leave_figures_blank

    with pytest.MonkeyPatch.context() as patch:
        leave_figures_blank(patch)
        yield

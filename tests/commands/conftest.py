"""Commands run without drawing the figures of their reports."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="module", autouse=True)
def no_figures(blank_figures: None) -> None:
    """Leave the figures blank: `tests/report` looks at them."""

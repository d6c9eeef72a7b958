"""Figures that nobody looks at: put together, but not drawn."""

import base64

import pytest

from recon.report import style

BLANK_PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGP4DwABAQEAG7buVgAAAABJRU5ErkJggg=="
)


def leave_figures_blank(patch: pytest.MonkeyPatch) -> None:
    """Write a blank image for each figure while the patch lasts: to draw a page takes seconds."""
    patch.setattr(style, "to_png", lambda *_: BLANK_PNG)

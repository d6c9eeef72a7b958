"""Stereo reconstruction and mapping: from image pairs to maps.

The whole flow in two lines::

    import recon

    run = recon.run_map(recon.open_source("kitti/sequences/06"), recon.load_config())

The public names stand in ``__init__.pyi``, with the module that each comes from. It is imported
when the name is first used, so ``import recon`` costs nothing.
"""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Any

from recon.core.lazy import SHOWN_BY

__version__ = "1.0.0"

_NAMES = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_HOME_OF = {
    name: module
    for module, name in re.findall(r"^from (\S+) import (\w+) as", _NAMES, re.MULTILINE)
}
__all__ = sorted(_HOME_OF)  # noqa: PLE0605 - a list


def __getattr__(name: str) -> Any:
    """Load a public name from its home (PEP 562)."""
    if name not in _HOME_OF:
        raise AttributeError(f"module 'recon' has no attribute {name!r}")
    return getattr(import_module(_HOME_OF[name]), name)


# What draws is imported when a value is asked to show itself.
SHOWN_BY.update(
    plot=lambda value: import_module("recon.report.notebook").plot(value),
    html=lambda value: import_module("recon.report.notebook").html(value),
    to_open3d=lambda value: import_module("recon.io.models.mesh").to_open3d(value),
)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])

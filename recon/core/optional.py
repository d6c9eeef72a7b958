"""Imports optional packages, at the moment they are needed."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from recon.core.errors import MissingDependencyError


def require(module: str, *, extra: str) -> ModuleType:
    """Import an optional package.

    Returns:
        The imported module.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"the optional package {module!r} is not installed",
            hint=f"run: pip install 'recon[{extra}]'",
        ) from error

"""Installs a tiny package with entry points, as pip would leave it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path


def install_plugin(
    site: Path, package: str, modules: Mapping[str, str], matchers: Mapping[str, str]
) -> None:
    """Write modules and metadata of a package that registers matchers into a folder of packages."""
    for name, source in modules.items():
        (site / name).write_text(source)
    info = site / f"{package.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    points = "".join(f"{name} = {value}\n" for name, value in matchers.items())
    (info / "entry_points.txt").write_text(f"[recon.matchers]\n{points}")

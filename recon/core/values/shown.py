"""What values show of themselves, by rooms above that are imported when they are asked."""

from __future__ import annotations

from typing import Any


class Shown:
    """A value that a notebook shows as a picture."""

    def plot(self) -> Any:
        """Return a matplotlib figure of it; nothing is shown or written by this."""
        from recon.report import notebook  # noqa: PLC0415

        return notebook.plot(self)

    def _repr_html_(self) -> str:
        from recon.report import notebook  # noqa: PLC0415

        return notebook.html(self)


class Shape(Shown):
    """A value that Open3D has, too."""

    def to_open3d(self) -> Any:
        """Return a copy as Open3D's legacy geometry, with colours and normals if it has them."""
        from recon.io.models import open3d_meshes  # noqa: PLC0415

        return open3d_meshes.to_open3d(self)

"""Triangle meshes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.core.values.arrays import Float32, Int32, UInt8, extent_text, freeze
from recon.core.words import counted


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A surface of triangles.

    Attributes:
        vertices: float32 (V, 3), metres.
        faces: int32 (F, 3), counter-clockwise seen from outside.
        normals: float32 (V, 3) unit vectors, or None.
        rgb: uint8 (V, 3), or None.
    """

    vertices: Float32
    faces: Int32
    normals: Float32 | None = None
    rgb: UInt8 | None = None

    def __post_init__(self) -> None:
        freeze(self, "vertices", np.float32, (None, 3))
        freeze(self, "faces", np.int32, (None, 3))
        freeze(self, "normals", np.float32, (len(self.vertices), 3))
        freeze(self, "rgb", np.uint8, (len(self.vertices), 3))

    def __repr__(self) -> str:
        vertices = counted(len(self.vertices), "vertex", "vertices")
        sizes = f"{counted(len(self.faces), 'face')}, {vertices}"
        return f"TriangleMesh({sizes}, {extent_text(self.vertices)})"

"""From a cloud to a trimmed surface."""

from recon.meshing.poisson import MeshSettings, reconstruct_mesh

__all__ = [
    "MeshSettings",
    "reconstruct_mesh",
]

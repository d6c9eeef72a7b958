"""From a cloud to a trimmed surface, in one piece or in tiles that meet."""

from recon.meshing.cut import Plane, close_seam, cut_mesh, open_edges
from recon.meshing.free_space import looked_through
from recon.meshing.poisson import MeshSettings, reconstruct_mesh

__all__ = [
    "MeshSettings",
    "Plane",
    "close_seam",
    "cut_mesh",
    "looked_through",
    "open_edges",
    "reconstruct_mesh",
]

"""From a cloud to a trimmed surface, in one piece or in tiles that meet."""

from recon.meshing.cut import Plane, cut_mesh
from recon.meshing.free_space import looked_through
from recon.meshing.poisson import MeshSettings, reconstruct_mesh
from recon.meshing.seams import close_seam, open_edges

__all__ = [
    "MeshSettings",
    "Plane",
    "close_seam",
    "cut_mesh",
    "looked_through",
    "open_edges",
    "reconstruct_mesh",
]

"""Surface meshes from point clouds, whole or in tiles with closed seams."""

from recon.meshing.cut import Plane, cut_mesh
from recon.meshing.free_space import looked_through
from recon.meshing.poisson import MeshSettings, reconstruct_mesh
from recon.meshing.seams import close_seam, open_edges
from recon.meshing.view import COVERED_WITHIN, mesh_coverage, reconstruct_view

__all__ = [
    "COVERED_WITHIN",
    "MeshSettings",
    "Plane",
    "close_seam",
    "cut_mesh",
    "looked_through",
    "mesh_coverage",
    "open_edges",
    "reconstruct_mesh",
    "reconstruct_view",
]

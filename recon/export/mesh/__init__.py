"""Surface meshes from point clouds, whole or in pieces with closed seams.

- `poisson.py`: the surface of a cloud; `view.py`: that of a single pair, as its camera saw it;
- `pieces.py`: that of a map, piece by piece, cut (`cut.py`), joined (`seams.py`) and trimmed
  (`surgery.py`).
"""

from recon.export.mesh.cut import Plane, cut_mesh
from recon.export.mesh.poisson import MeshSettings, reconstruct_mesh
from recon.export.mesh.seams import close_seam, open_edges
from recon.export.mesh.view import check_coverage, mesh_coverage, reconstruct_view

__all__ = [
    "MeshSettings",
    "Plane",
    "check_coverage",
    "close_seam",
    "cut_mesh",
    "mesh_coverage",
    "open_edges",
    "reconstruct_mesh",
    "reconstruct_view",
]

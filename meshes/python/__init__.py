"""Meshes of triangles and tetrahedra with named regions and boundaries: from gmsh's files, scripts and live models, and ready shapes.

Importing it loads gmsh and METIS, and neither PETSc nor MPI.
"""

from ._meshes import Mesh2D, Mesh3D, annulus, box, channel, current_model, cylinder_in_channel, pipe, read

"""The fluid between the grains, or alone: volume-averaged Navier-Stokes by finite elements on a simplex mesh.

Importing it starts nothing; the first `Fluid` starts MPI and PETSc.
"""

from ._fluid import Fluid2D, Fluid3D, NotConverged, Report, petsc_options, rank, ranks


def Fluid(mesh, *, density, viscosity, element="p1p1", gravity=None):
    """Flow on a mesh of `quicksand.meshes`, at rest at the start, void fraction 1.

    Parameters
    ----------
    mesh : Mesh2D or Mesh3D
    density : float
        [kg/m^3]; 0 for a flow without inertia.
    viscosity : float
        Dynamic, > 0 [Pa s].
    element : str
        "p1p1": linear velocity and pressure, stabilised (SUPG, PSPG, LSIC); "p2p1": quadratic velocity, with grad-div.
    gravity : (dim,)
        [m/s^2]; none by default.

    Every boundary needs a condition before the first step: `wall`, `inflow`, `slip`, `outflow` or `permeable`.
    """
    return {2: Fluid2D, 3: Fluid3D}[mesh.dim](mesh, density=density, viscosity=viscosity, element=element, gravity=gravity)

"""Fluid and grains together: unresolved FEM-DEM, grains of `quicksand.grains` in the flow of `quicksand.fluid`."""

from ._coupling import Coupling2D, Coupling3D, drag_coefficient

LAWS = ("di_felice", "gidaspow", "beetstra")


def Coupling(grains, fluid, *, kernel="smooth", kernel_radius=None, drag="di_felice", discs="spheres", undisturbed=False, added_mass=0.0, fluid_moves=True, grains_move=True):
    """Couples a `Simulation` and a `Fluid` on a mesh that holds all of its grains; `step` makes the steps of both.

    Parameters
    ----------
    grains : Simulation2D or Simulation3D
        Its period must be that of the mesh. Forces and drag on its grains are set by the coupling from now on.
    fluid : Fluid2D or Fluid3D
        Void fraction and reaction are set by the coupling from now on, its scheme is backward_euler.
    kernel : str
        "smooth": what a grain weighs at the nodes does not depend on the mesh, as far as it is finer than the kernel, and changes smoothly with
        its place; "hat": the linear shape functions of its element.
    kernel_radius : float
        Standard deviation of the smooth kernel along an axis [m], 1.5 mean diameters by default. The kernel ends at 3.16 (discs) or 3.32 (spheres) of
        them; half of its weight is within 1.26 or 1.64 of them.
    drag : str or callable
        "di_felice" (with Dallavalle's sphere), "gidaspow" (Ergun, Wen and Yu), "beetstra", or f(slip, void_fraction, diameter, density, viscosity)
        with arrays (n,) of slip [m/s], void fraction, diameter [m], and two numbers, which gives gamma (n,) [kg/s] of spheres: the force on a
        grain is gamma (u - v), without what pressure gradient and viscous stress do.
    discs : str
        How discs borrow the drag of spheres: "spheres", per volume of solids, at the void fraction of equally close spheres; "cylinders": as
        published 2D computations with MigFlow, gamma 4/(pi d) per metre of depth at the void fraction of the discs.
    undisturbed : bool
        3D: drag by the flow as it would be without the grain, whose own averaged wake is told in closed form (steady; of unbounded flow, slowed by the
        drag of grains around; about as long along all axes as elements are). A single grain then falls as the law says, not 5 to 22 % faster (slow flow); in beds of
        solids above 0.1 it changes next to nothing.
    added_mass : float
        C_m [-]: a grain feels m_a (Du/Dt - dv/dt) besides, m_a = C_m times the fluid that it displaces, the fluid feels the opposite (Auton, Hunt and
        Prud'homme, J. Fluid Mech. 197 (1988); Maxey and Riley, Phys. Fluids 26 (1983)). 0.5 of a sphere by itself, and of a disc that stands for a
        column of spheres (displaced per metre of depth; of a cylinder 1); no dependence on the solid fraction. Du/Dt follows the fluid, mean over the kernel.
        Grains of less than about a quarter of the fluid's density need it: without, they are unstable where pressure binds them to the fluid.
        With fluid_moves=False it knows the flow's gradient only.
    fluid_moves, grains_move : bool
        False: the fluid stays as it is and feels no grain; the grains stay where they are, a porous bed.

    Raises
    ------
    ValueError
        Where periods differ, elements are too coarse for the kernel, or values make no sense.
    """
    if kernel_radius is None:
        if kernel == "smooth" and grains.count == 0:
            raise ValueError("Coupling: there are no grains yet to take kernel_radius from, 1.5 mean diameters; add grains first, or give it [m]")
        kernel_radius = 3.0 * grains.radius.mean() if grains.count else 0.0
    if grains.dim != fluid.dim:
        raise ValueError(f"Coupling: grains in {grains.dim}D, fluid in {fluid.dim}D")
    return {2: Coupling2D, 3: Coupling3D}[fluid.dim](grains, fluid, kernel, kernel_radius, drag, discs, undisturbed, added_mass, fluid_moves, grains_move)

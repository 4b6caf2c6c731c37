"""Scenes of grains in a fluid that several tests share; lengths in grain diameters, d = 1 mm."""

import numpy as np

from quicksand import coupling, fluid, grains, meshes

D, DENSITY, WATER, VISCOSITY = 1e-3, 2500.0, 1000.0, 1e-3
GRAVITY = 9.81


def spheres_void_fraction(eps):
    """At which the drag of discs is taken."""
    return 1 - 2 / np.sqrt(np.pi * np.sqrt(3)) * (1 - eps) ** 1.5


def gamma(dim, slip, eps, law="di_felice", viscosity=VISCOSITY):
    """Of one grain of diameter D, at the void fraction of its own dimension."""
    if dim == 3:
        return coupling.drag_coefficient(law, slip, eps, D, WATER, viscosity)
    return 1.5 / D * coupling.drag_coefficient(law, slip, spheres_void_fraction(eps), D, WATER, viscosity)


def volume(dim):
    return np.pi * D**3 / 6 if dim == 3 else np.pi * D**2 / 4


def simulation(dim, position, period=None, gravity=None, **settings):
    sim = grains.Simulation(dim=dim, period=period, gravity=gravity, **settings)
    sim.set_friction("grain", "grain", 0.5)
    sim.set_friction("grain", "wall", 0.5)
    sim.add(position, D / 2, density=DENSITY)
    return sim


def lattice(counts, lengths, low, jitter=0.0, seed=0):
    """Cell centres of a grid, moved at random by up to `jitter` of what keeps neighbours apart."""
    axes = [(np.arange(n) + 0.5) * length / n + a for n, length, a in zip(counts, lengths, low)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(counts))
    room = min(length / n for n, length in zip(counts, lengths)) - D
    return x + np.random.default_rng(seed).uniform(-0.5, 0.5, x.shape) * jitter * room


def periodic_bed(dim, *, mesh_over_d, k, side=12, kernel="smooth", radius=1.5, law="di_felice", element="p1p1", velocity=1e-4, viscosity=VISCOSITY):
    """A bed that is held, driven by a body force that the law says makes the superficial `velocity`; dt = k relaxation times.

    Returns coupling, fluid, the void fraction, and a function that gives the law's pressure gradient [Pa/m] for the flow found.
    """
    length = side * D
    counts = [int(side / 1.15)] * dim
    x = lattice(counts, [length] * dim, [-length / 2] * dim, jitter=0.3)
    eps = 1 - len(x) * volume(dim) / length**dim
    cells = max(2, round(side / mesh_over_d))
    mesh = meshes.box([length] * dim, [cells] * dim, periodic=[True] * dim, origin=[-length / 2] * dim)

    def gradient(superficial):
        slip = superficial / eps
        return len(x) / length**dim * gamma(dim, slip, eps, law, viscosity) * slip / eps

    flow = fluid.Fluid(mesh, density=WATER, viscosity=viscosity, element=element, gravity=[gradient(velocity) / WATER] + [0.0] * (dim - 1))
    flow.mean_pressure(0.0)
    sim = simulation(dim, x, period=[length] * dim)
    both = coupling.Coupling(sim, flow, kernel=kernel, kernel_radius=radius * D, drag=law, grains_move=False)
    dt = k * sim.mass[0] / gamma(dim, velocity / eps, eps, law, viscosity)
    return both, flow, dt, gradient


def superficial_velocity(flow):
    """Mean of eps u over the mesh (dim,) [m/s]; of linear elements, up to the product of two linear functions."""
    corners = flow.mesh.elements
    x = flow.nodes[corners]
    weight = np.abs(np.linalg.det(x[:, 1:] - x[:, :1]))
    flux = (flow.void_fraction[:, None] * flow.velocity)[corners].mean(axis=1)
    return (weight[:, None] * flux).sum(axis=0) / weight.sum()


def grain_in_the_middle(dim, diameter, density, viscosity=VISCOSITY):
    """Of a box of fluid at rest, and where that is."""
    down, box = [0.0] * (dim - 1) + [-GRAVITY], 20 * diameter
    flow = fluid.Fluid(meshes.box([box] * dim, size=box / 4), density=WATER, viscosity=viscosity, gravity=down)
    for boundary in flow.mesh.boundary_names:
        flow.wall(boundary)
    flow.solve_steady()
    sim = grains.Simulation(dim=dim, gravity=down)
    sim.set_friction("grain", "grain", 0.3)
    middle = np.full((1, dim), box / 2)
    sim.add(middle, diameter / 2, density=density)
    return flow, sim, middle


def nothing(slip, *_):
    """A law without drag."""
    return 0 * slip

"""Small versions of examples/stability_fluid.py: where methods of this kind fail, and what is said there."""

import numpy as np
import pytest
from quicksand import fluid, meshes

ELEMENTS = ("p1p1", "p2p1")
GRAVITY = 9.81


def flow_in_box(element, lengths=(1.0, 1.0), counts=(8, 8), density=1.0, viscosity=1.0, gravity=None, **shape):
    mesh = meshes.box(list(lengths), counts=list(counts), **shape)
    return mesh, fluid.Fluid(mesh, density=density, viscosity=viscosity, element=element, gravity=gravity)


@pytest.mark.parametrize("axis", (0, 1))
@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("element", ELEMENTS)
def test_water_rests_in_pores_that_jump_from_node_to_node(element, dim, axis):
    """eps grad p is tested with what eps rho g is: nothing is left. 1e-10 g dt is the tolerance of the linear systems, ten times over."""
    mesh, flow = flow_in_box(element, [1.0] * dim, [6 if dim == 2 else 3] * dim, 1000.0, 1e-3, -GRAVITY * np.eye(dim)[axis])
    for name in mesh.boundary_names:
        flow.wall(name)
    flow.void_fraction = np.random.default_rng(0).uniform(0.05, 1.0, len(mesh.nodes))
    flow.reaction(beta=lambda x, t: np.where(x[:, 0] < 0.5, 0.0, 1e6), target=np.zeros(dim))
    for _ in range(5):
        report = flow.step(0.01)
        assert report.pore_volume_rate == 0.0  # sums of BDF2's weights once made pores grow by rounding, which a closed box refused
        assert np.abs(flow.velocity).max() < 1e-10 * GRAVITY * 0.01
    off = flow.pressure + 1000.0 * GRAVITY * (mesh.nodes[:, axis] - 0.5)
    assert np.abs(off - off.mean()).max() < 1e-8 * 1000.0 * GRAVITY


@pytest.mark.parametrize("element", ELEMENTS)
def test_steps_of_a_hundred_picoseconds_do_not_make_pores_grow(element):
    mesh, flow = flow_in_box(element, viscosity=0.01)
    for name in mesh.boundary_names:
        flow.wall(name)
    flow.void_fraction = np.random.default_rng(0).uniform(0.3, 0.5, len(mesh.nodes))
    flow.reaction(force=lambda x, t: np.column_stack([-x[:, 1], x[:, 0]]))
    for _ in range(3):
        assert flow.step(1e-10).pore_volume_rate == 0.0


@pytest.mark.parametrize("element", ELEMENTS)
def test_a_plug_enters_a_porous_half_of_any_resistance(element):
    """U = 1 exactly. beta h^2/eta = 1e6 left MUMPS without room for pivots once. Rounding of p = 1e8 Pa moves u by 1e-9."""
    _, flow = flow_in_box(element, (1.0, 0.5), (16, 8))
    for side in ("bottom", "top"):
        flow.slip(side)
    flow.inflow("left", [1.0, 0.0])
    flow.outflow("right")
    flow.reaction(beta=lambda x, t: 1e6 * 16**2 * (x[:, 0] > 0.5))
    flow.solve_steady()
    assert np.abs(flow.velocity - [1.0, 0.0]).max() < 1e-8


def test_newton_ends_where_velocities_are_nothing_but_rounding():
    """At rest the change of u is as large as u; with p = 0 that of p as large as p. Neither is a failure."""
    mesh, flow = flow_in_box("p1p1", [1.0] * 3, [4] * 3, 1000.0, 1e-3, (0, -GRAVITY, 0))
    for name in mesh.boundary_names:
        flow.wall(name)
    flow.void_fraction = np.where(mesh.nodes[:, 0] < 0.4, 1.0, 0.05)
    assert flow.solve_steady().change < 1e-9
    assert np.abs(flow.velocity).max() < 1e-6
    _, flow = flow_in_box("p2p1", [6.0, 6.0], (8, 8), 1.0, 0.01, periodic=[True, True])
    flow.advection = "newton"
    flow.set_velocity(np.array([1.0, 0.5]) + 1e-9 * np.sin(np.pi / 3 * flow.nodes[:, ::-1]))
    for _ in range(5):
        assert flow.step(10.0).newton_iterations <= 10

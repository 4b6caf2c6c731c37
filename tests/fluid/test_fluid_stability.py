"""Small versions of examples/stability_fluid.py: where methods of this kind fail, and what is said there."""

import warnings

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
    """eps grad p is tested with what eps rho g is: nothing is left but the tolerance of the linear systems, 1e-11 a step, of what is scaled to be about 1."""
    mesh, flow = flow_in_box(element, [1.0] * dim, [6 if dim == 2 else 3] * dim, 1000.0, 1e-3, -GRAVITY * np.eye(dim)[axis])
    for name in mesh.boundary_names:
        flow.wall(name)
    flow.void_fraction = np.random.default_rng(0).uniform(0.05, 1.0, len(mesh.nodes))
    flow.reaction(beta=lambda x, t: np.where(x[:, 0] < 0.5, 0.0, 1e6), target=np.zeros(dim))
    for _ in range(5):
        report = flow.step(0.01)
        assert report.pore_volume_rate == 0.0  # sums of BDF2's weights once made pores grow by rounding, which a closed box refused
        assert np.abs(flow.velocity).max() < 1e-9 * GRAVITY * 0.01
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
    assert np.abs(flow.velocity).max() < 1e-4  # 1e-11 of rho g h, over eta/h: 6e-6 m/s
    _, flow = flow_in_box("p2p1", [6.0, 6.0], (8, 8), 1.0, 0.01, periodic=[True, True])
    flow.advection = "newton"
    flow.set_velocity(np.array([1.0, 0.5]) + 1e-9 * np.sin(np.pi / 3 * flow.nodes[:, ::-1]))
    for _ in range(5):
        assert flow.step(10.0).newton_iterations <= 10


@pytest.mark.parametrize("element", ELEMENTS)
def test_pressure_survives_a_sudden_change_of_the_time_step(element):
    """From a steady flow with 1e-6 s: nothing happens. p1p1 once answered with 1e4 times the pressure, because its stabilisation time changes with dt;
    now its subscales go on. 1e-4: Newton's tolerance of 1e-9 of a velocity u is rho u L/dt of pressure, relative to rho u^2."""
    _, flow = flow_in_box(element, counts=(16, 16), viscosity=0.01)
    flow.wall("top", [1.0, 0.0])
    for side in ("left", "right", "bottom"):
        flow.wall(side)
    flow.newton_tolerance = 1e-12
    flow.solve_steady()
    p = flow.pressure
    for dt in (1e-6, 1e-6, 1e-5, 1e-3):
        flow.step(dt)
        assert np.abs(flow.pressure - p).max() < 1e-4 * np.abs(p).max()


@pytest.mark.parametrize("element", ELEMENTS)
def test_reports_know_how_far_a_step_goes_and_how_steep_the_void_fraction_is(element):
    """Uniform U = 2, h = 1/8: Courant number u dt/h, cell Peclet number rho u h/eta, both where u = U/eps is fastest, up to the mean over an element."""
    for low in (0.5, 0.25):
        mesh, flow = flow_in_box(element, density=3.0, viscosity=0.1)
        for side in ("bottom", "top"):
            flow.slip(side)
        flow.inflow("left", [2.0, 0.0])
        flow.outflow("right")
        flow.void_fraction = np.where(mesh.nodes[:, 0] < 0.49, 1.0, low)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            reports = [flow.step(0.01), flow.step(0.02), flow.solve_steady()]
        assert len(told) == (low < 1 / 3) and all("4-fold" in str(w.message) for w in told)
        assert reports[0].eps_jump == pytest.approx(1 / low - 1)
        fast = 2.0 / low  # the flux is right to 20 % in these two steps, and away from the jump
        assert reports[1].courant == pytest.approx(fast * 0.02 * 8, rel=0.2) and reports[2].courant == 0.0
        assert reports[1].peclet == pytest.approx(3.0 * fast / 8 / 0.1, rel=0.2)


@pytest.mark.parametrize("element, largest", (("p1p1", 0.01), ("p2p1", 0.005)))
@pytest.mark.parametrize("dt", (1e-3, 1e-8))
def test_a_force_that_begins_at_once_meets_its_pressure_in_any_step(element, largest, dt):
    """grad(phi) + curl(psi): p = phi, cos(pi x) cos(pi y), while u is still small. 0.4 and 0.25 % is the error of 16 cells."""
    mesh, flow = flow_in_box(element, counts=(16, 16), viscosity=1e-3)
    for side in mesh.boundary_names:
        flow.wall(side)
    s, c = (lambda a: np.sin(np.pi * a)), (lambda a: np.cos(np.pi * a))
    flow.reaction(force=lambda x, t: np.pi * np.column_stack([
        -s(x[:, 0]) * c(x[:, 1]) + 2 * s(x[:, 0]) ** 2 * s(x[:, 1]) * c(x[:, 1]),
        -c(x[:, 0]) * s(x[:, 1]) - 2 * s(x[:, 0]) * c(x[:, 0]) * s(x[:, 1]) ** 2]))
    for _ in range(3):
        flow.step(dt)
    p = c(mesh.nodes[:, 0]) * c(mesh.nodes[:, 1])
    assert np.sqrt(np.mean((flow.pressure - p) ** 2) / np.mean(p**2)) < largest

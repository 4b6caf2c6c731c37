"""Drag of the laws: single grains that fall, held beds that fluid goes through."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from quicksand import coupling, fluid, meshes
from scenes import D, GRAVITY, VISCOSITY, WATER, grain_in_the_middle, lattice, periodic_bed, simulation, superficial_velocity


def falling_grain(dim, diameter, density, law, dt_over_tau, steps):
    """One grain in a fluid that stays at rest: velocity after the steps, that of the law, and the time."""
    flow, sim, middle = grain_in_the_middle(dim, diameter, density)
    solid = np.pi * diameter**3 / 6  # of the sphere that the law is of
    weight = abs(density - WATER) * solid * GRAVITY

    def drag(speed):
        return speed * coupling.drag_coefficient(law, speed, 1.0, diameter, WATER, VISCOSITY)

    terminal = brentq(lambda speed: drag(speed) - weight, 1e-9, 1e3, xtol=1e-16)
    tau = density * solid * terminal / weight
    both = coupling.Coupling(sim, flow, kernel="hat", drag=law, fluid_moves=False)
    for _ in range(steps):
        sim.position = middle
        both.step(dt_over_tau * tau)
    exact = solve_ivp(lambda t, v: (weight - drag(v[0])) / (density * solid), (0, steps * dt_over_tau * tau), [0.0], rtol=1e-10, atol=1e-14)
    return abs(sim.velocity[0, -1]), terminal, exact.y[0, -1]


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dt_over_tau", [0.01, 1.0, 100.0])
@pytest.mark.parametrize("diameter, density", [(1e-4, 3000.0), (1e-3, 100.0), (2e-2, 3000.0)])  # Re about 1, 100, 2e4
def test_a_grain_reaches_its_terminal_velocity(dim, dt_over_tau, diameter, density):
    steps = max(20, round(20 / dt_over_tau))
    speed, terminal, _ = falling_grain(dim, diameter, density, "di_felice", dt_over_tau, steps)
    assert speed == pytest.approx(terminal, rel=1e-6)


def test_glass_in_water_falls_as_published():
    speed, _, _ = falling_grain(3, 1e-3, 2500.0, "di_felice", 1.0, 30)
    assert speed == pytest.approx(0.1341, rel=1e-3)
    speed, _, _ = falling_grain(3, 1e-3, 2500.0, "gidaspow", 1.0, 30)
    assert speed == pytest.approx(0.1459, rel=1e-3)


def test_the_way_to_the_terminal_velocity_is_of_first_order():
    errors = []
    for ratio in (0.04, 0.02):
        speed, _, exact = falling_grain(3, 1e-3, 2500.0, "di_felice", ratio, round(0.5 / ratio))
        errors.append(abs(speed - exact))
    assert np.log2(errors[0] / errors[1]) > 0.9


@pytest.mark.parametrize("law", ["di_felice", "gidaspow", "beetstra"])
def test_dilute_drag_is_that_of_a_sphere_and_dense_drag_that_of_a_bed(law):
    stokes = 3 * np.pi * VISCOSITY * D
    assert coupling.drag_coefficient(law, 1e-9, 1.0, D, WATER, VISCOSITY) == pytest.approx(stokes, rel=0.05)
    # Ergun's bed of spheres, viscous: drag per volume over the superficial velocity.
    eps, slip = 0.4, 1e-7
    bed = 150 * (1 - eps) ** 2 * VISCOSITY / (eps * D**2)
    assert (1 - eps) / (np.pi * D**3 / 6) * coupling.drag_coefficient(law, slip, eps, D, WATER, VISCOSITY) == pytest.approx(bed, rel=0.25)


def test_a_law_from_python_does_as_the_built_in_one():
    def ergun(slip, eps, diameter, density, viscosity):
        reynolds = density * eps * diameter * slip / viscosity
        return np.pi * viscosity * diameter / eps * (25 * (1 - eps) + 1.75 / 6 * reynolds)

    found = []
    for law in ("gidaspow", ergun):
        both, flow, dt, _ = periodic_bed(2, mesh_over_d=3, k=1.0, law=law)
        for _ in range(3):
            both.step(dt)
        found.append(flow.velocity)
    assert np.allclose(*found, rtol=1e-10, atol=1e-15)


@pytest.mark.parametrize("dim, mesh_over_d, element", [(2, 0.5, "p1p1"), (2, 2, "p1p1"), (2, 6, "p1p1"), (2, 3, "p2p1"), (3, 2, "p1p1"), (3, 4, "p1p1")])
def test_a_periodic_bed_has_the_pressure_gradient_of_the_law(dim, mesh_over_d, element):
    both, flow, dt, gradient = periodic_bed(dim, mesh_over_d=mesh_over_d, k=1e4, element=element, side={0.5: 12, 6: 24}.get(mesh_over_d, 12) if dim == 2 else 8)
    driven = gradient(1e-4)
    for _ in range(8):
        report = both.step(dt)
        assert report.momentum_error < 1e-12 and report.volume_error < 1e-12
    n = len(flow.mesh.nodes)
    if element == "p1p1":
        assert driven == pytest.approx(gradient(superficial_velocity(flow)[0]), rel=5e-4)
    assert np.abs(flow.velocity[:n, 1]).max() < 0.05 * flow.velocity[:n, 0].max()


def shear_cell(grains_move):
    """A bed between plates that slide past each other, as the fluid and the grains in it do: the flow is simple shear already."""
    width, height, speed = 12 * D, 15 * D, 0.1
    x = lattice((9, 11), (width, height), (-width / 2, -height / 2), jitter=0.3)
    sim = simulation(2, x, period=(width, None))
    sim.velocity = np.column_stack([2 * speed * x[:, 1] / height, 0 * x[:, 0]])
    flow = fluid.Fluid(meshes.box([width, height], [4, 5], periodic=[True, False], origin=[-width / 2, -height / 2]), density=WATER, viscosity=0.1)
    flow.permeable("top", velocity=(speed, 0.0)), flow.permeable("bottom", velocity=(-speed, 0.0))
    flow.set_velocity(np.column_stack([2 * speed * flow.nodes[:, 1] / height, 0 * flow.nodes[:, 0]]))
    return sim, flow, coupling.Coupling(sim, flow, grains_move=grains_move), 2 * speed / height


def test_drag_makes_no_viscosity_of_its_own():
    """Grains that go with a sheared fluid feel no drag, wherever their kernel ends, and the plates feel the fluid's viscosity only."""
    sim, flow, both, rate = shear_cell(True)
    report = both.step(1e-5)
    drag = np.linalg.norm(both.drag_force, axis=1).max()
    assert drag < 0.01 * sim.mass[0] * rate / 1e-5 * D  # of what a grain would feel that is a diameter off
    traction = 0.1 * rate * 12 * D
    assert -flow.force("top")[0] == pytest.approx(traction, rel=0.2) and flow.force("bottom")[0] == pytest.approx(traction, rel=0.2)
    assert report.momentum_error < 1e-9

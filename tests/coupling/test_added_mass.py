"""Fluid that goes along with grains: single ones, both phases accelerated, beds of light grains."""

import numpy as np
import pytest

from quicksand import coupling, fluid, grains, meshes
from scenes import D, GRAVITY, VISCOSITY, WATER, gamma, grain_in_the_middle, lattice, nothing, simulation, superficial_velocity, volume


def released(dim, density, law, dt, steps, viscosity=VISCOSITY):
    """Speed of a light grain in a fluid that stays at rest, with added mass."""
    flow, sim, middle = grain_in_the_middle(dim, D, density, viscosity)
    both = coupling.Coupling(sim, flow, kernel="hat", drag=law, fluid_moves=False, added_mass=0.5)
    for _ in range(steps):
        sim.position = middle
        assert both.step(dt).grains.sub_steps == 1  # as many as its acceleration asks for
    return sim.velocity[0, -1]


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("density", [1.0, 100.0, 2500.0])
def test_a_grain_released_at_rest_moves_the_fluid_around_it_as_well(dim, density):
    acceleration = (WATER - density) * GRAVITY / (density + 0.5 * WATER)
    assert released(dim, density, nothing, 1e-3, 1) == pytest.approx(1e-3 * acceleration, rel=1e-13)


@pytest.mark.parametrize("density", [1.0, 100.0])
def test_a_light_grain_relaxes_as_heavy_as_it_is_with_that_fluid(density):
    gamma = 1e-5
    tau = (density + 0.5 * WATER) * volume(3) / gamma
    exact = (WATER - density) * volume(3) * GRAVITY / gamma * (1 - np.exp(-1))
    errors = [abs(released(3, density, lambda slip, *_: 0 * slip + gamma, tau / n, n, viscosity=1e3) / exact - 1) for n in (50, 100)]
    assert np.log2(errors[0] / errors[1]) > 0.95 and errors[1] < 0.4 / 100


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("ratio", [1e-3, 0.1, 1.0, 2.5])
def test_an_accelerated_fluid_takes_a_grain_along(dim, ratio):
    """By its pressure and by added mass, dv/dt = (1 + C_m)/(ratio + C_m) du/dt: a grain as dense as the fluid follows it."""
    box, rate, dt, steps = 20 * D, 2.0, 1e-3, 5
    flow = fluid.Fluid(meshes.box([box] * dim, [4] * dim), density=WATER, viscosity=VISCOSITY)
    for boundary in flow.mesh.boundary_names:
        flow.wall(boundary, velocity=lambda x, t: np.column_stack([0 * x[:, 0] + rate * t] + [0 * x[:, 0]] * (dim - 1)))
    flow.set_pressure(-WATER * rate * (flow.nodes[:, 0] - box / 2)), flow.mean_pressure(0.0)
    sim = grains.Simulation(dim=dim)
    sim.set_friction("grain", "grain", 0.3)
    place = np.full((1, dim), 0.45 * box)
    sim.add(place, 5e-6, density=ratio * WATER)  # of next to no weight in the fluid
    both = coupling.Coupling(sim, flow, kernel_radius=5 * D, drag=nothing, added_mass=0.5)
    for _ in range(steps):
        sim.position = place
        both.step(dt)
    assert sim.velocity[0, 0] == pytest.approx(1.5 / (ratio + 0.5) * rate * dt * steps, rel=1e-6)
    assert np.abs(sim.velocity[0, 1:]).max() < 1e-6 * rate * dt * steps


@pytest.mark.parametrize("dim, ratio", [(2, 1e-3), (2, 0.1), (3, 0.5)])
def test_two_phases_accelerate_each_other(dim, ratio):
    """The fluid alone is driven, in a periodic box: eps du/dt = eps g - phi C_m (du/dt - dv/dt), ratio dv/dt = C_m (du/dt - dv/dt), of densities over the fluid's."""
    side, dt = (12 if dim == 2 else 9) * D, 1e-3
    x = lattice((int(side / D / 1.5),) * dim, [side] * dim, [-side / 2] * dim)
    sim = grains.Simulation(dim=dim, period=[side] * dim)
    sim.set_friction("grain", "grain", 0.3)
    sim.add(x, D / 2, density=ratio * WATER)
    flow = fluid.Fluid(meshes.box([side] * dim, [4] * dim, periodic=[True] * dim, origin=[-side / 2] * dim), density=WATER, viscosity=VISCOSITY, gravity=[1.0] + [0.0] * (dim - 1))
    flow.mean_pressure(0.0)
    both = coupling.Coupling(sim, flow, kernel_radius=2 * D, drag=nothing, added_mass=0.5)
    phi = len(x) * volume(dim) / side**dim
    added = 0.5 * phi
    exact = np.linalg.solve([[1 - phi + added, -added], [-added, phi * ratio + added]], [1 - phi, 0.0])
    for step in range(5):
        before = np.array([superficial_velocity(flow)[0] / (1 - phi), sim.velocity[:, 0].mean()])
        report = both.step(dt)
        assert report.momentum_error * report.exchanged_impulse < 1e-12 * WATER * side**dim * dt  # of the impulse of the driving force
        after = np.array([superficial_velocity(flow)[0] / (1 - phi), sim.velocity[:, 0].mean()])
        if step > 1:  # the first answer is that of grains held, the second gives back what it owes
            assert after - before == pytest.approx(dt * exact, rel=1e-7)
    assert after == pytest.approx(5 * dt * exact, rel=1e-7)


def test_the_fluid_accelerates_where_its_velocity_changes_from_place_to_place():
    """Du/Dt of u = a (x, -y) is a^2 (x, y)."""
    a, box, dt = 3.0, 24 * D, 1e-3
    flow = fluid.Fluid(meshes.box([box, box], [12, 12], origin=[-box / 2] * 2), density=WATER, viscosity=VISCOSITY)
    for boundary in flow.mesh.boundary_names:
        flow.wall(boundary)
    flow.mean_pressure(0.0)
    flow.set_velocity(a * flow.nodes * (1, -1))
    place = np.array([[3.1 * D, 1.7 * D]])
    sim = grains.Simulation(dim=2)
    sim.set_friction("grain", "grain", 0.3)
    sim.add(place, D / 2, density=100.0)
    both = coupling.Coupling(sim, flow, drag=nothing, fluid_moves=False, added_mass=0.5)
    both.step(dt)
    assert sim.velocity[0] == pytest.approx(5 / 6 * dt * a**2 * place[0], rel=1e-3)  # as well as the kernel reads


def test_a_mesh_that_moves_accelerates_no_fluid():
    """In steady shear u = S y the rate at a node that goes up is S w; the grain feels none of it."""
    width, height, shear, speed, dt = 12 * D, 15 * D, 50.0, 0.5, 1e-4
    flow = fluid.Fluid(meshes.box([width, height], [4, 5], periodic=[True, False], origin=[-width / 2, 0.0]), density=WATER, viscosity=0.1)
    sim = grains.Simulation(dim=2, period=(width, None))
    sim.set_friction("grain", "grain", 0.3), sim.set_friction("grain", "wall", 0.3)
    floor, lid = sim.add_plane((0, 0), (0, 1)), sim.add_plane((0, height), (0, -1), velocity=(None, speed))
    y = 7.1 * D
    sim.add(np.array([[0.1 * D, y]]), 1e-3 * D, density=100.0)
    sim.velocity = np.array([[shear * y, 0.0]])
    flow.wall("bottom"), flow.permeable("top", velocity=lambda x, t: np.column_stack([shear * x[:, 1], 0 * x[:, 1]]), pressure=0.0)
    flow.set_velocity(np.column_stack([shear * flow.nodes[:, 1], 0 * flow.nodes[:, 1]]))
    both = coupling.Coupling(sim, flow, kernel_radius=1.5 * D, drag=nothing, added_mass=0.5)
    both.follow("bottom", floor), both.follow("top", lid)
    for _ in range(5):
        both.step(dt)
    felt = 5 / 6 * shear * speed * y / height  # were the mesh forgotten
    assert flow.nodes[:, 1].max() > height * 1.01
    assert np.abs(both.drag_force[0]).max() / sim.mass[0] < 2 * dt * speed / height * felt  # its own motion in a step, first order


def test_a_steady_flow_through_a_bed_does_not_know_the_step_by_added_mass():
    """It is inertia: taken for a drag of m_a/dt by the stabilisation, velocities differ by 3 %."""
    found = []
    for dt, steps in ((1e-2, 300), (1e-3, 1500)):
        sim = simulation(2, lattice((8, 8), (12 * D, 12 * D), (-6 * D, 6 * D), jitter=0.6), period=(12 * D, None))
        flow = fluid.Fluid(meshes.box([12 * D, 24 * D], [8, 16], periodic=[True, False], origin=[-6 * D, 0.0]), density=WATER, viscosity=VISCOSITY)
        flow.inflow("bottom", (0.0, 0.02)), flow.outflow("top")
        both = coupling.Coupling(sim, flow, kernel_radius=1.5 * D, grains_move=False, added_mass=0.5)
        for _ in range(steps):
            both.step(dt)
        found.append(flow.velocity)
    assert np.abs(found[1] - found[0]).max() < 1e-3 * 0.02


def light_bed(ratio, k, added_mass, steps, gap=1.6):
    """A bed of light grains that rises in a closed box, dt = k relaxation times (m + m_a)/gamma."""
    width, height = 12 * D, 40 * D
    x = lattice((int(12 / gap), int(18 / gap)), (width, 18 * D), (-width / 2, 2 * D), jitter=0.6)
    sim = grains.Simulation(dim=2, period=(width, None), gravity=(0, -GRAVITY))
    sim.set_friction("grain", "grain", 0.5), sim.set_friction("grain", "wall", 0.5)
    sim.add(x, D / 2, density=ratio * WATER)
    sim.add_plane((0, 0), (0, 1)), sim.add_plane((0, height), (0, -1))
    flow = fluid.Fluid(meshes.box([width, height], [4, 13], periodic=[True, False], origin=[-width / 2, 0.0]), density=WATER, viscosity=1e-2, gravity=(0, -GRAVITY))
    flow.wall("bottom"), flow.wall("top"), flow.mean_pressure(0.0)
    both = coupling.Coupling(sim, flow, kernel_radius=1.5 * D, added_mass=added_mass)
    dt = k * (ratio + added_mass) * WATER * volume(2) / gamma(2, 0.0, 0.7, viscosity=1e-2)
    speeds, reports = [], []
    for _ in range(steps):
        reports.append(both.step(dt))
        speeds.append(sim.velocity[:, 1].mean())
    return np.array(speeds), reports


@pytest.mark.parametrize("ratio", [0.01, 0.1])
@pytest.mark.parametrize("k", [0.01, 0.1, 1.0, 10.0, 100.0])
def test_a_bed_of_light_grains_rises_without_swinging(ratio, k):
    speeds, reports = light_bed(ratio, k, 0.5, 30)
    assert -1e-4 < speeds.min() and speeds.max() < 0.05  # twice what it settles at
    if k < 2:  # else it is at the top by then
        rates = np.diff(speeds)[4:]  # the first answer is that of grains held, and given back in the second
        assert np.abs(rates).sum() - np.abs(rates.sum()) < 0.02 * speeds[-1]  # to and fro
    largest = 0.0
    for report in reports:
        largest = max(largest, report.exchanged_impulse)
        assert report.momentum_error * report.exchanged_impulse < 1e-12 * largest


def test_added_mass_is_what_keeps_a_light_bed_from_swinging():
    """Without it the same bed swings ever wilder: the test above can fail."""
    speeds, _ = light_bed(0.01, 0.1, 0.0, 15)
    assert np.abs(speeds).max() > 1.0


@pytest.mark.parametrize("added_mass, law, left", [(0.0, "di_felice", 0.5), (0.5, "di_felice", 0.5), (0.5, nothing, 0.1)])  # drag's own difference of u and its mean stays
def test_another_pass_brings_the_phases_together(added_mass, law, left):
    apart = []
    for passes in (1, 3):
        x = lattice((11, 17), (12 * D, 18 * D), (-6 * D, 0.0), jitter=0.6)
        sim = simulation(2, x, period=(12 * D, None), gravity=(0, -GRAVITY), accept_unconverged=True)
        sim.add_plane((0, 0), (0, 1)), sim.add_plane((0, 40 * D), (0, -1))
        flow = fluid.Fluid(meshes.box([12 * D, 40 * D], [4, 13], periodic=[True, False], origin=[-6 * D, 0.0]), density=WATER, viscosity=1e-2, gravity=(0, -GRAVITY))
        flow.wall("bottom"), flow.wall("top"), flow.mean_pressure(0.0)
        both = coupling.Coupling(sim, flow, drag=law, added_mass=added_mass)
        both.tolerance, both.max_passes = 1e-9, passes
        reports = [both.step(1e-3) for _ in range(20)]
        assert all(report.passes == passes and report.momentum_error < 1e-12 for report in reports)
        apart.append(np.mean([report.disagreement for report in reports[10:]]))
    assert apart[1] < left * apart[0]

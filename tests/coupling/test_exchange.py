"""What grains and fluid hand to each other: volume, pressure, momentum; and who leaves."""

import sys
from pathlib import Path

import numpy as np
import pytest

from quicksand import coupling, fluid, grains, meshes
from scenes import D, DENSITY, GRAVITY, VISCOSITY, WATER, lattice, simulation

ROOT = Path(__file__).parents[2]


def uniform_reading(mesh, spacing, radius, inside):
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    axes = [np.arange(a + spacing / 2, b, spacing) for a, b in zip(low, high)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(low))
    x = x[inside(x)]
    dim, r = len(low), 0.2 * spacing
    sim = grains.Simulation(dim=dim)
    sim.set_friction("grain", "grain", 0.3)
    sim.add(x, r, density=DENSITY)
    flow = fluid.Fluid(mesh, density=WATER, viscosity=1.0)
    for boundary in mesh.boundary_names:
        flow.wall(boundary)
    flow.mean_pressure(0.0)
    both = coupling.Coupling(sim, flow, kernel_radius=radius, grains_move=False)
    both.step(1.0)
    solid = np.pi * r**2 if dim == 2 else 4 / 3 * np.pi * r**3
    x = flow.nodes[mesh.elements]
    shares = np.abs(np.linalg.det(x[:, 1:] - x[:, :1])) / (2 if dim == 2 else 6)
    total = (shares * (1 - flow.void_fraction)[mesh.elements].mean(axis=1)).sum()
    assert total == pytest.approx(len(sim.position) * solid, rel=1e-12)  # no volume is lost
    return (1 - flow.void_fraction) / (solid / spacing**dim)


@pytest.mark.parametrize("size", [0.3, 0.1, 0.05])
def test_a_uniform_field_of_grains_reads_uniform_up_to_walls_and_corners(size):
    reading = uniform_reading(meshes.box([1, 1], size=size), 0.01, 0.1, lambda x: np.full(len(x), True))
    assert np.abs(reading - 1).max() < 0.01


def test_it_does_in_a_cube():
    reading = uniform_reading(meshes.box([1, 1, 1], [6, 6, 6]), 1 / 32, 0.12, lambda x: np.full(len(x), True))
    assert np.abs(reading - 1).max() < 0.01


def test_it_does_along_curved_walls():
    size = 0.1
    mesh = meshes.annulus(0.5, 1.5, size)
    rim = 1.5 * np.cos(np.pi / round(2 * np.pi * 1.5 / size))  # inside of the polygon

    def inside(x):
        r = np.linalg.norm(x, axis=1)
        return (r > 0.5) & (r < rim)

    assert np.abs(uniform_reading(mesh, 0.01, 0.1, inside) - 1).max() < 0.05


def test_a_void_fraction_of_one_that_rounding_put_above_is_one():
    """The weights of a disc here add up to 1 + 2e-16: the void fraction of spheres is of no negative number."""
    sim = simulation(2, np.array([[0.0, 0.0]]), gravity=(0, -GRAVITY))
    flow = fluid.Fluid(meshes.box([20 * D] * 2, size=5 * D, origin=[-10 * D] * 2), density=WATER, viscosity=VISCOSITY)
    for boundary in flow.mesh.boundary_names:
        flow.wall(boundary)
    flow.mean_pressure(0.0)
    both = coupling.Coupling(sim, flow, kernel="hat", fluid_moves=False)
    for x in np.random.default_rng(0).uniform(-9, 9, (200, 2)) * D:
        sim.position = x[None]
        both.step(1e-3)


def test_a_grain_on_the_face_of_an_element_weighs_nothing_negative():
    """Of its coordinates there one may be below 0, by rounding."""
    for seed in range(20):
        x = lattice((4, 4, 4), [12 * D] * 3, [-6 * D] * 3) + np.random.default_rng(seed).integers(-3, 4, (64, 3)) * D / 4
        flow = fluid.Fluid(meshes.box([12 * D] * 3, [4] * 3, periodic=[True] * 3, origin=[-6 * D] * 3), density=WATER, viscosity=VISCOSITY)
        flow.mean_pressure(0.0)
        coupling.Coupling(simulation(3, x, period=[12 * D] * 3), flow, kernel="hat").step(1e-3)


@pytest.mark.parametrize("kernel, jumps_on", [("smooth", False), ("hat", True)])
def test_pressure_of_a_grain_that_crosses_an_element_face(kernel, jumps_on):
    """d(eps)/dt makes pressure; that of the smooth kernel has no jump as the grain comes to another element."""
    sys.path.insert(0, str(ROOT / "examples"))
    from accuracy_coupling import jump

    jumps = [jump(0.0 if kernel == "hat" else 1.5, dt) for dt in (1e-3, 2.5e-4)]
    assert jumps[1] > 0.7 * jumps[0] if jumps_on else jumps[1] < 0.4 * jumps[0]


def test_a_lid_drains_what_the_pores_lose():
    """A loaded lid presses a bed: through it flows what the domain loses, and the mesh stays with the lid."""
    x = lattice((9, 12), (12 * D, 15 * D), (-6 * D, 0.0), jitter=0.6)
    sim = simulation(2, x, period=(12 * D, None))
    floor, lid = sim.add_plane((0, 0), (0, 1)), sim.add_plane((0, 15.5 * D), (0, -1), load=(None, -0.1))
    flow = fluid.Fluid(meshes.box([12 * D, 15.5 * D], [4, 5], periodic=[True, False], origin=[-6 * D, 0.0]), density=WATER, viscosity=VISCOSITY)
    flow.wall("bottom"), flow.permeable("top", pressure=0.0)
    both = coupling.Coupling(sim, flow)
    both.follow("top", lid), both.follow("bottom", floor)
    drained, start = 0.0, lid.position[1]
    for _ in range(50):
        before = lid.position[1]
        report = both.step(2e-3)
        assert flow.nodes[:, 1].max() == pytest.approx(before, abs=1e-14)
        drained += 2e-3 * flow.flux("top")
        assert report.volume_error < 1e-11 and report.momentum_error < 1e-9
    assert before < start - 0.3 * D
    assert drained == pytest.approx(12 * D * (start - before), rel=1e-10)


@pytest.mark.parametrize("added_mass", [0.0, 0.5])
def test_grains_leave_through_an_outlet_and_are_counted(added_mass):
    mesh = meshes.box([10 * D, 10 * D], [4, 4])
    flow = fluid.Fluid(mesh, density=WATER, viscosity=VISCOSITY)
    flow.wall("bottom"), flow.wall("top"), flow.inflow("left", (0.01, 0.0)), flow.outflow("right")
    sim = simulation(2, np.array([[2 * D, 5 * D], [9 * D, 5 * D], [9 * D, 2 * D]]))
    sim.velocity = np.full((3, 2), (0.02, 0.0))
    both = coupling.Coupling(sim, flow, kernel_radius=1.5 * D, added_mass=added_mass)
    both.outlet("right")
    removed = sum(both.step(0.01).removed for _ in range(20))
    assert removed == both.removed == 2 and sim.count == 1


def test_the_mixture_has_all_the_momentum_that_plates_give():
    """Both plates begin to move the same way; the fluid drags free grains along. Their rows and layers move through the mesh."""
    length, height, dt = 60 * D, 40 * D, 1e-3
    mesh = meshes.box([length, height], [15, 10], periodic=[True, False], origin=[-length / 2, -height / 2])
    flow = fluid.Fluid(mesh, density=WATER, viscosity=0.15)
    for plate in ("bottom", "top"):
        flow.permeable(plate, velocity=(0.1, 0.0), pressure=0.0)
    sim = simulation(2, lattice((46, 30), (length, height - 2 * D), (-length / 2, D - height / 2), jitter=0.2), period=(length, None))
    both = coupling.Coupling(sim, flow, kernel_radius=1.5 * D)
    corners = flow.nodes[mesh.elements]
    area = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 2

    def momentum():
        flux = flow.void_fraction * flow.velocity[:, 0]  # linear in elements
        return WATER * area @ flux[mesh.elements].mean(axis=1) + sim.mass @ sim.velocity[:, 0]

    for _ in range(20):  # at first much of it is carried
        both.step(dt)
    before, given = momentum(), 0.0
    for _ in range(100):
        both.step(dt)
        given -= dt * sum(flow.force(plate)[0] for plate in ("bottom", "top"))
    assert momentum() - before == pytest.approx(given, rel=2e-3)  # 1.3 % was lost where bulk viscosity acts on the fluid alone


def test_a_velocity_that_is_set_stays_when_grains_come():
    """The flux is that of the void fraction that comes first."""
    flow = fluid.Fluid(meshes.box([1, 1], [4, 4]), density=1.0, viscosity=1.0)
    flow.set_velocity((1.0, 2.0))
    flow.void_fraction = 0.4
    assert np.allclose(flow.velocity, (1.0, 2.0), rtol=1e-14)

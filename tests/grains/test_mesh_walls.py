"""Walls from the boundaries of a mesh, and what C++ tests of drag and removal leave to Python: arrays in and out."""

from types import SimpleNamespace

import numpy as np
import pytest

from quicksand import grains

R = 1e-3  # [m]


def box(dim, n=6, size=20 * R):
    """The floor y = 0 and the sides x = 0, x = size of a box, with what Simulation.walls asks a mesh for; n facets (2D) a side."""
    t = np.linspace(0, size, n + 1)
    if dim == 2:
        lines = {"floor": np.stack([t, 0 * t], 1), "sides": np.stack([0 * t, t], 1), "right": np.stack([size + 0 * t, t], 1)}
    else:
        a, b = (x.ravel() for x in np.meshgrid(t, t, indexing="ij"))
        lines = {"floor": np.stack([a, 0 * a, b - size / 2], 1), "sides": np.stack([0 * a, a, b - size / 2], 1),
                 "right": np.stack([size + 0 * a, a, b - size / 2], 1)}
    nodes, facets, boundary = [], [], []
    for number, corners in enumerate(lines.values()):
        first = sum(map(len, nodes))
        if dim == 2:
            own = [(k, k + 1) for k in range(n)]
        else:
            quads = [i * (n + 1) + j for i in range(n) for j in range(n)]
            own = [f for q in quads for f in ((q, q + 1, q + n + 2), (q, q + n + 2, q + n + 1))]
        nodes.append(corners), facets.extend(np.array(own) + first), boundary.extend([min(number, 1)] * len(own))
    return SimpleNamespace(nodes=np.concatenate(nodes), facets=np.array(facets), boundary=np.array(boundary), boundary_names=["floor", "sides"])


def scene(dim):
    sim = grains.Simulation(dim, gravity=(0, -9.81, 0)[:dim], tolerance=1e-8)
    sim.set_friction("grain", "grain", 0.3)
    sim.set_friction("grain", "wall", 0.3)
    return sim


@pytest.mark.parametrize("dim", [2, 3])
def test_grains_fall_into_a_box_of_mesh_facets_and_its_floor_bears_their_weight(dim):
    sim, mesh = scene(dim), box(dim)
    floor = sim.walls(mesh, ["floor"])
    sides = sim.walls(mesh, ["sides"])
    assert floor == list(range(len(floor))) and sides == list(range(len(floor), len(floor) + len(sides)))
    assert len(floor) + len(sides) == len(mesh.facets)
    x = np.array([(2.2 * R * (i + 1), 1.5 * R + 2.5 * R * j, 0)[:dim] for i in range(8) for j in range(2)])
    sim.add(x, R, 2500.0)
    sim.tolerance = 1e-4
    for _ in range(600):
        sim.step(5e-4)
    assert np.all(sim.position[:, 1] > R * (1 - 1e-3)) and np.all(np.abs(sim.position[:, 0] / R - 10) < 9 + 1e-3)
    weight = sim.mass.sum() * 9.81
    assert -sim.wall_force[floor].sum(0)[1] - sim.wall_force[sides].sum(0)[1] == pytest.approx(weight, rel=0.02)  # some still roll


@pytest.mark.parametrize("dim", [2, 3])
def test_walls_of_a_mesh_are_driven_as_one(dim):
    sim = scene(dim)
    numbers = sim.walls(box(dim), ["floor"], velocity=(0, 0.1, None)[:dim])
    sim.add([(10 * R, R, 0.1 * R)[:dim]], R, 2500.0, velocity=[(0, 0.1, 0)[:dim]])
    for _ in range(50):
        sim.step(1e-3)
    assert sim.velocity[0] == pytest.approx((0, 0.1, 0)[:dim], abs=1e-8)
    assert sim.position[0, 1] == pytest.approx(R + 5e-3, abs=1e-8 * R)
    assert sim.wall(numbers[-1]).velocity[1] == 0.1 and sim.wall(numbers[0]).number == numbers[0]


def test_walls_told_apart_from_what_is_no_boundary_or_no_mesh():
    sim, mesh = scene(2), box(2)
    for call, kind, words in [
            (lambda: sim.walls(mesh, ["floor", "roof"]), ValueError, "walls: the mesh has no boundary 'roof', known: 'floor', 'sides'"),
            (lambda: sim.walls(box(3), ["floor"]), ValueError, "walls: nodes of the mesh must be an array of shape"),
            (lambda: sim.walls(mesh, ["floor"], material="marble"), ValueError, "add_segment: unknown material 'marble'"),
            (lambda: sim.walls(mesh, ["floor"], velocity=(0, np.inf)), ValueError, "walls: velocity must be finite, got inf m/s (axis 1)"),
            (lambda: sim.walls(None, ["floor"]), TypeError, "walls: mesh must have nodes, facets, boundary and boundary_names"),
            (lambda: sim.wall(0), ValueError, "wall: no wall 0, the scene has 0")]:
        with pytest.raises(kind) as told:
            call()
        assert words in str(told.value)
    bad = box(3)
    bad.nodes[bad.facets[7]] = 0.0  # one facet is a point: those before it are taken back
    with pytest.raises(ValueError, match="add_triangle: corners"):
        scene(3).walls(bad, ["floor"])
    assert len(sim.wall_force) == 0


def test_walls_take_meshes_as_they_are():
    meshes = pytest.importorskip("quicksand.meshes")
    pipe = meshes.pipe(10 * R, 20 * R, 3 * R)
    sim = scene(3)
    numbers = sim.walls(pipe, [name for name in pipe.boundary_names if "wall" in name])
    sim.add([(10 * R, -7 * R, 0)], R, 2500.0)
    for _ in range(1000):
        sim.step(1e-3)
    lowest = pipe.nodes[:, 1].min()
    assert lowest < sim.position[0, 1] - R < 0.9 * lowest  # in the trough of a polygon
    assert -sim.wall_force[numbers].sum(0)[1] == pytest.approx(sim.mass[0] * 9.81, rel=1e-3)


@pytest.mark.parametrize("dim", [2, 3])
def test_drag_takes_and_gives_arrays_by_id_and_grains_leave_with_theirs(dim):
    sim = scene(dim)
    sim.gravity = np.zeros(dim)
    sim.add([(4 * R * k, 0, 0)[:dim] for k in range(4)], R, 2500.0)
    gamma, u = sim.mass * [1, 10, 100, 1e5] / 1e-3, np.array([(0.01 * (k + 1), 0, 0)[:dim] for k in range(4)])
    sim.set_drag(gamma, u)
    sim.step(1e-3)
    k = np.array([1, 10, 100, 1e5])
    assert sim.velocity[:, 0] == pytest.approx(k / (1 + k) * u[:, 0], rel=1e-12)
    assert sim.drag_impulse[:, 0] == pytest.approx(sim.mass * sim.velocity[:, 0], rel=1e-9)
    assert not sim.in_contact.any() and sim.in_contact.dtype == bool and np.all(sim.contact_impulse == 0)
    sim.remove(np.flatnonzero(gamma < 5 * gamma[0]))
    assert sim.count == 3 and sim.drag_impulse.shape == (3, dim)
    sim.remove([])
    sim.step(1e-3)
    assert sim.velocity[:, 0] == pytest.approx((1 - 1 / (1 + k[1:]) ** 2) * u[1:, 0], rel=1e-12)
    sim.set_drag(None)
    with pytest.raises(ValueError, match="drag_impulse: there is no drag"):
        sim.drag_impulse

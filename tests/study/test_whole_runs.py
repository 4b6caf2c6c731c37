"""examples/whole_runs.py: what it measures by itself, and the state it hands to LAMMPS. test_speed_accuracy_contacts.py makes its runs."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
import whole_runs  # noqa: E402

R = whole_runs.RADIUS


def test_overlaps_are_found_across_the_period_and_gaps_are_none():
    position = np.array([[0.1 * R, 0], [10 * R - 1.8 * R, 0], [4 * R, 0], [6.1 * R, 0], [4 * R, 1.96 * R]])  # depths 0.1 R, none, 0.04 R
    mean, largest = whole_runs.overlaps(position, np.full(5, R), 10 * R)
    assert (mean, largest) == pytest.approx((0.07 / 2, 0.1 / 2))  # in diameters
    assert whole_runs.overlaps(position[2:4], np.full(2, R), 10 * R) == (0.0, 0.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_lammps_starts_from_the_same_places_and_velocities(dim, tmp_path):
    if dim == 2:
        scene = whole_runs.make_scene(quick=True)
        sim, walls, period, wall_grains = scene.sim, scene.walls, scene.width, scene.fixed_grains()
    else:
        cell = whole_runs.Spheres(200, 6)
        sim, walls, period, wall_grains = cell.sim, cell.walls, cell.period, cell.wall_grains()
    for _ in range(5):
        sim.step(1e-4)
    whole_runs.write_data(tmp_path / "start.data", sim, walls, period, wall_grains)
    _, atoms, velocities = (tmp_path / "start.data").read_text().replace("Velocities", "Atoms # sphere").split("Atoms # sphere")
    atoms, velocities = (np.array([line.split() for line in part.strip().splitlines()], float) for part in (atoms, velocities))
    n, rows = sim.count, len(wall_grains[1])
    assert len(atoms) == len(velocities) == n + rows
    np.testing.assert_array_equal(atoms[:, 1], np.repeat([1, 2, 3], [n, rows // 2, rows // 2]))
    np.testing.assert_allclose(atoms[:n, 2], 2 * sim.radius)
    np.testing.assert_allclose(atoms[:n, 5], sim.position[:, 1] - walls[0].position[1], atol=1e-9)
    np.testing.assert_allclose(velocities[:n, 1:1 + dim], sim.velocity, rtol=1e-8, atol=1e-12)
    speeds = [wall.velocity[0] for wall in walls]
    np.testing.assert_allclose(velocities[n:, 1], np.repeat(speeds, rows // 2))
    assert speeds[0] == -speeds[1] < 0
    assert 0 <= atoms[:, 4].min() and atoms[:, 4].max() < period

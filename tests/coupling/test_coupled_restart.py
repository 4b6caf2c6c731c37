"""A coupled run that goes on from its state, on any number of processes."""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from quicksand import coupling, fluid, meshes
from scenes import D, GRAVITY, VISCOSITY, WATER, lattice, simulation

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("added_mass", [0.0, 0.5])
def test_a_run_that_is_restored_goes_on_bit_for_bit(added_mass):
    def scene():
        x = lattice((9, 12), (12 * D, 15 * D), (-6 * D, 2 * D), jitter=0.6)
        sim = simulation(2, x, period=(12 * D, None), gravity=(0, -GRAVITY))
        floor, lid = sim.add_plane((0, 0), (0, 1)), sim.add_plane((0, 20 * D), (0, -1), load=(None, -1.0))
        flow = fluid.Fluid(meshes.box([12 * D, 20 * D], [4, 7], periodic=[True, False], origin=[-6 * D, 0.0]), density=WATER, viscosity=VISCOSITY, gravity=(0, -GRAVITY))
        flow.wall("bottom"), flow.permeable("top", pressure=0.0)
        both = coupling.Coupling(sim, flow, added_mass=added_mass)
        both.follow("top", lid), both.follow("bottom", floor)
        return sim, flow, both

    first = scene()
    for _ in range(5):
        first[2].step(1e-3)
    kept = [part.state() for part in first]
    for _ in range(5):
        first[2].step(1e-3)
    second = scene()
    for part, state in zip(second, kept):
        part.restore(state)
    for _ in range(5):
        second[2].step(1e-3)
    for name in ("position", "velocity"):
        assert np.array_equal(getattr(first[0], name), getattr(second[0], name))
    for name in ("velocity", "pressure", "void_fraction", "nodes"):
        assert np.array_equal(getattr(first[1], name), getattr(second[1], name))


SCRIPT = """
import sys
import os
import subprocess
from pathlib import Path

import numpy as np
sys.path.insert(0, sys.argv[3])
from quicksand import coupling, fluid, meshes
from scenes import D, VISCOSITY, WATER, lattice, simulation

numbers = []
for dim, added_mass in ((2, 0.0), (3, 0.0), (2, 0.5)):
    side = 12 * D if dim == 2 else 8 * D
    along, down = [side] * (dim - 1), [0.0] * (dim - 1) + [-9.81]
    x = lattice((int(side / D / 1.3),) * (dim - 1) + (6,), along + [8 * D], [-side / 2] * (dim - 1) + [D], jitter=0.6)
    sim = simulation(dim, x, period=along + [None], gravity=down)
    floor, lid = sim.add_plane([0.0] * dim, [0.0] * (dim - 1) + [1.0]), sim.add_plane([0.0] * (dim - 1) + [12 * D], [0.0] * (dim - 1) + [-1.0], velocity=[None] * (dim - 1) + [-0.01])
    mesh = meshes.box(along + [12 * D], [4] * dim, periodic=[True] * (dim - 1) + [False], origin=[-side / 2] * (dim - 1) + [0.0])
    flow = fluid.Fluid(mesh, density=WATER, viscosity=VISCOSITY, gravity=down)
    bottom, top = ("bottom", "top") if dim == 2 else ("back", "front")
    flow.wall(bottom), flow.permeable(top, pressure=0.0)
    both = coupling.Coupling(sim, flow, added_mass=added_mass)
    both.follow(bottom, floor), both.follow(top, lid)
    for _ in range(3):
        both.step(1e-3)
    kept = [part.state() for part in (sim, flow, both)]
    for _ in range(2):
        both.step(1e-3)
    there = [sim.velocity, flow.velocity]
    for part, state in zip((sim, flow, both), kept):
        part.restore(state)
    for _ in range(2):
        both.step(1e-3)
    assert np.array_equal(there[0], sim.velocity) and np.array_equal(there[1], flow.velocity)  # on as many processes, bit for bit
    numbers += [*(flow.velocity.ravel() / 0.01), *(sim.velocity.ravel() / 0.01), *(flow.pressure / 100)]
assert fluid.ranks() == int(sys.argv[2])
if fluid.rank() == 0:
    np.save(sys.argv[1], numbers)
"""


def test_any_number_of_processes_gives_the_same_coupled_flow(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    env = {name: value for name, value in os.environ.items() if not name.startswith(("PMIX_", "OMPI_"))}
    found = []
    for n in (1, 2):
        done = subprocess.run([ROOT / "run", "-n", str(n), tmp_path / "script.py", tmp_path / f"{n}.npy", str(n), Path(__file__).parent], capture_output=True, text=True, timeout=200, env=env)
        assert done.returncode == 0, done.stderr
        found.append(np.load(tmp_path / f"{n}.npy"))
    assert np.abs(found[1] - found[0]).max() < 1e-6

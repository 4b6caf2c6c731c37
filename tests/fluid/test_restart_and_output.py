"""A restored run goes on bit for bit, on 1 and 2 processes; files can be read."""

import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from quicksand import fluid, grains, meshes

ROOT = Path(__file__).parents[2]


def channel(element="p1p1", **settings):
    flow = fluid.Fluid(meshes.box([1.0, 1.0], counts=[6, 6], periodic=[True, False]), density=1.0, viscosity=0.01, element=element, **settings)
    flow.wall("bottom")
    flow.permeable("top", velocity=[1.0, 0.0])
    flow.move_boundary("top", lambda x, t: np.full_like(x, -0.2) * [0.0, 1.0] * np.cos(t))
    flow.void_fraction = lambda x, t: 0.6 + 0.2 * np.sin(x[:, 1] + t)
    return flow


@pytest.mark.parametrize("element", ("p1p1", "p2p1"))
def test_a_restored_run_goes_on_bit_for_bit(element):
    flow = channel(element)
    for _ in range(3):
        flow.step(0.02)
    state = flow.state()
    other = channel(element)
    other.restore(state)
    for _ in range(3):
        flow.step(0.02)
        other.step(0.02)
    for name in ("velocity", "pressure", "nodes", "time", "void_fraction"):
        assert np.array_equal(getattr(flow, name), getattr(other, name)), name
    assert np.array_equal(flow.force("top"), other.force("top")) and flow.flux("top") == other.flux("top")


def test_a_state_of_another_mesh_is_refused():
    state = channel().state()
    with pytest.raises(ValueError, match="of another mesh or element"):
        channel("p2p1").restore(state)
    other = fluid.Fluid(meshes.box([1.0, 1.1], counts=[6, 6], periodic=[True, False]), density=1.0, viscosity=0.01)
    with pytest.raises(ValueError, match="make the fluid on the mesh it was saved with"):
        other.restore(state)
    with pytest.raises(ValueError, match="of another mesh"):
        channel().restore(state[:-1])


@pytest.mark.parametrize("element, cell, nodes", (("p1p1", "Triangle", 3), ("p2p1", "Triangle_6", 6)))
def test_frames_hold_the_flow_and_paraview_finds_it(tmp_path, element, cell, nodes):
    flow = channel(element)
    frames = grains.Frames(tmp_path)
    for _ in range(2):
        flow.step(0.02)
        frames.write(flow)
    with h5py.File(tmp_path / "run.h5") as file:
        group = file["frames/000001/fluid"]
        n = len(flow.nodes)  # then come images, across the period, of the middles of edges
        assert np.allclose(group["position"][:n, :2], flow.nodes) and np.allclose(group["velocity"][:n, :2], flow.velocity)
        assert np.array_equal(group["void_fraction"][:n], flow.void_fraction)
        assert group["connectivity"].shape == (72, nodes) and len(group["pressure"]) == len(group["position"])
        x, cells = group["position"][:, :2], group["connectivity"][:]
        # Middles of edges where XDMF wants them.
        for k, (a, b) in enumerate([(0, 1), (1, 2), (2, 0)][: nodes - 3]):
            assert np.allclose(x[cells[:, 3 + k]], 0.5 * (x[cells[:, a]] + x[cells[:, b]]), atol=1e-12)
    text = (tmp_path / "fluid.xdmf").read_text()
    assert text.count(f'TopologyType="{cell}"') == 2 and 'Name="velocity" AttributeType="Vector" Center="Node"' in text


def test_petsc_options_pass_through(tmp_path):
    (tmp_path / "script.py").write_text("""
from quicksand import fluid, meshes
fluid.petsc_options("-ksp_max_it 1 -pc_type none")
flow = fluid.Fluid(meshes.box([1.0, 1.0], counts=[4, 4]), density=1.0, viscosity=1.0)
for name in flow.mesh.boundary_names:
    flow.wall(name, [1.0, 0.0] if name == "top" else None)
try:
    flow.step(0.1)
except fluid.NotConverged as error:
    print(error)
""")
    env = {name: value for name, value in os.environ.items() if not name.startswith(("PMIX_", "OMPI_"))} | {"PETSC_OPTIONS": "-ksp_converged_reason"}
    done = subprocess.run([ROOT / "run", tmp_path / "script.py"], capture_output=True, text=True, timeout=100, env=env)
    assert "solve did not converge due to DIVERGED_ITS" in done.stdout  # PETSc's own words, from the option in the environment
    assert "step: velocity and pressure not found in step 1, t = 0 s: DIVERGED_ITS after 1 iterations" in done.stdout


SCRIPT = """
import sys
import numpy as np
from quicksand import fluid, meshes
numbers = []
for element in ("p1p1", "p2p1"):
    for dim in (2, 3):
        mesh = meshes.box([1.0] * dim, counts=[8 if dim == 2 else 3] * dim, periodic=[True] + [False] * (dim - 1))
        flow = fluid.Fluid(mesh, density=1.0, viscosity=0.01, element=element)
        for name in mesh.boundary_names:
            flow.permeable(name, velocity=[1.0] + [0.0] * (dim - 1)) if name == "top" else flow.wall(name)
        flow.move_boundary("top", [0.0, -0.1] + [0.0] * (dim - 2))
        x = flow.nodes
        flow.void_fraction = 0.6 + 0.3 * np.sin(2 * np.pi * x[:, 0]) * x[:, 1] ** 2
        flow.reaction(beta=2.0)
        for _ in range(3):
            flow.step(0.1)
        saved = flow.state()
        for _ in range(2):
            flow.step(0.1)
        after = flow.velocity
        flow.restore(saved)
        for _ in range(2):
            flow.step(0.1)
        # MUMPS adds up what its processes send as it comes; everything else is the same each time.
        exact = fluid.ranks() == 1 or dim == 3
        assert np.array_equal(after, flow.velocity) if exact else np.abs(after - flow.velocity).max() < 1e-8 * np.abs(after).max()
        numbers += [*flow.velocity.ravel(), *flow.pressure, *flow.force("top"), flow.flux("top")]
if fluid.rank() == 0:
    np.save(sys.argv[1], numbers)
assert fluid.ranks() == int(sys.argv[2])
"""


def test_any_number_of_processes_gives_the_same_flow(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    found = []
    # This process may have started MPI itself, and would hand on that it is one of its processes.
    env = {name: value for name, value in os.environ.items() if not name.startswith(("PMIX_", "OMPI_"))}
    for n in (1, 2, 4):
        done = subprocess.run([ROOT / "run", "-n", str(n), tmp_path / "script.py", tmp_path / f"{n}.npy", str(n)], capture_output=True, text=True, timeout=200, env=env)
        assert done.returncode == 0, done.stderr
        found.append(np.load(tmp_path / f"{n}.npy"))
    for one in found[1:]:
        assert np.abs(one - found[0]).max() < 1e-8 * np.abs(found[0]).max()

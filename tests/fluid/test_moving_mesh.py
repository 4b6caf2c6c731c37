"""Moving meshes: a uniform flow stays uniform, volumes balance, and what would fold is refused."""

import numpy as np
import pytest
from quicksand import fluid, meshes

ELEMENTS = ("p1p1", "p2p1")


def box(dim, cells, element, **settings):
    mesh = meshes.box([1.0] * dim, counts=[cells] * dim, **settings.pop("shape", {}))
    flow = fluid.Fluid(mesh, element=element, **({"density": 1.0, "viscosity": 0.1} | settings))
    return mesh, flow


@pytest.mark.parametrize("scheme", ("backward_euler", "bdf2"))
@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("dim", (2, 3))
def test_uniform_flow_stays_uniform_on_a_mesh_that_moves_anyhow(dim, element, scheme):
    mesh, flow = box(dim, 6 if dim == 2 else 3, element)
    flow.scheme = scheme
    u = np.array([1.0, 0.5, 0.3])[:dim]
    for name in mesh.boundary_names:
        flow.inflow(name, u)
        flow.move_boundary(name, lambda x, t: 0.3 * np.sin(2 * x[:, ::-1] + t) * np.arange(1, dim + 1))
    flow.set_velocity(u)
    for _ in range(5):
        report = flow.step(0.05)
        assert report.volume_error < 1e-12  # the domain grows and shrinks: what it sweeps enters
    assert abs(report.pore_volume_rate) > 1e-4
    assert np.abs(flow.nodes[: len(mesh.nodes)] - mesh.nodes).max() > 0.05
    assert np.abs(flow.velocity - u).max() < 1e-12


@pytest.mark.parametrize("motion", ("harmonic", "stretch"))
@pytest.mark.parametrize("element", ELEMENTS)
def test_a_piston_drives_out_what_the_pores_lose(element, motion):
    """A permeable plate comes down on a bed whose void fraction changes in space and time: outflow = - d/dt of the pore volume."""
    _, flow = box(2, 6, element, shape={"periodic": [True, False]})
    flow.mesh_motion = motion
    flow.wall("bottom")
    flow.permeable("top", pressure=3.0)
    flow.move_boundary("top", [0.0, -0.2])
    flow.move_boundary("bottom", [0.0, 0.0])
    flow.void_fraction = lambda x, t: 0.6 + 0.3 * x[:, 1] ** 2 * np.cos(t)
    for k in range(6):
        report = flow.step(0.05 * (1 + 0.3 * k))  # BDF2 with steps that grow
        assert report.volume_error < 1e-10
        assert flow.flux("top") == pytest.approx(-report.pore_volume_rate, abs=1e-10)
        assert abs(flow.flux("bottom")) < 1e-14
    assert flow.flux("top") > 0.1
    # The flow is one of plugs: nothing moves sideways but by what the elements cannot resolve.
    assert np.abs(flow.velocity[:, 0]).max() < (1e-10 if element == "p1p1" else 0.02)


def test_volume_per_step_of_a_piston_without_pores_is_the_swept_one():
    _, flow = box(3, 2, "p1p1", shape={"periodic": [True, False, True]})
    flow.wall("bottom")
    flow.permeable("top")
    flow.move_boundary("top", [0.0, -0.2, 0.0])
    flow.step(0.1)
    assert flow.flux("top") == pytest.approx(0.2, rel=1e-10)  # relative to the plate, which passes through fluid at rest
    assert np.abs(flow.velocity).max() < 1e-10


def test_side_walls_let_their_nodes_slide():
    mesh, flow = box(2, 4, "p1p1")
    for name in ("left", "right"):
        flow.slip(name)
    flow.wall("bottom")
    flow.permeable("top")
    flow.move_boundary("top", [0.0, -0.5])
    flow.step(0.5)
    # Linear between top and bottom, and the same at the sides as in the middle.
    assert np.allclose(flow.nodes, mesh.nodes * [1.0, 1.0] - [0.0, 0.25] * ((mesh.nodes[:, 1:] + 0.5 * (mesh.nodes[:, 1].min() < 0)) * [0.0, 1.0]), atol=1e-12)


def test_a_mesh_that_would_fold_is_refused_and_nothing_has_moved():
    mesh, flow = box(2, 4, "p1p1", shape={"periodic": [True, False]})
    flow.wall("bottom")
    flow.permeable("top")
    flow.move_boundary("top", [0.0, -3.0])
    flow.step(0.1)
    before = flow.nodes.copy(), flow.velocity.copy(), flow.time
    with pytest.raises(ValueError, match="folds the mesh at .* smaller steps, or make a new mesh"):
        flow.step(1.0)
    for was, now in zip(before, (flow.nodes, flow.velocity, flow.time)):
        assert np.array_equal(was, now)
    flow.step(0.05)  # and goes on


def test_stretching_needs_two_boundaries_that_move_as_a_whole():
    _, flow = box(2, 3, "p1p1", shape={"periodic": [True, False]})
    flow.wall("bottom")
    flow.permeable("top")
    flow.mesh_motion = "stretch"
    flow.move_boundary("top", [0.0, -0.1])
    with pytest.raises(ValueError, match="between two boundaries that move, got 1"):
        flow.step(0.1)
    flow.move_boundary("bottom", lambda x, t: 0.1 * np.sin(x))
    with pytest.raises(ValueError, match='"bottom" does not'):
        flow.step(0.1)

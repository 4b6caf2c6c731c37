"""What cannot be coupled is named."""

import numpy as np
import pytest

from quicksand import coupling, fluid, grains, meshes
from scenes import D, VISCOSITY, WATER, simulation


def test_what_cannot_be_is_named():
    mesh = meshes.box([10 * D, 10 * D], [4, 4])
    flow = fluid.Fluid(mesh, density=WATER, viscosity=VISCOSITY)
    for boundary in mesh.boundary_names:
        flow.wall(boundary)
    flow.mean_pressure(0.0)
    outside = simulation(2, np.array([[5 * D, 5 * D], [11 * D, 5 * D]]))
    with pytest.raises(ValueError, match=r"grain 1 at .* outside the mesh, beyond boundary \"right\".*outlet"):
        coupling.Coupling(outside, flow).step(1e-3)
    sim = simulation(2, np.array([[5 * D, 5 * D]]))
    with pytest.raises(ValueError, match="kernel must be one of"):
        coupling.Coupling(sim, flow, kernel="gauss")
    with pytest.raises(ValueError, match="drag must be one of"):
        coupling.Coupling(sim, flow, drag="stokes")
    with pytest.raises(ValueError, match="undisturbed is of spheres"):
        coupling.Coupling(sim, flow, undisturbed=True)
    with pytest.raises(ValueError, match="too small for elements"):
        coupling.Coupling(sim, flow, kernel_radius=1e-2 * D)
    with pytest.raises(ValueError, match="period along axis 0"):
        coupling.Coupling(simulation(2, np.array([[5 * D, 5 * D]]), period=(10 * D, None)), flow)
    with pytest.raises(ValueError, match="no grains yet"):
        coupling.Coupling(grains.Simulation(dim=2), flow)
    with pytest.raises(ValueError, match="3D, fluid in 2D"):
        coupling.Coupling(simulation(3, np.array([[5 * D] * 3])), flow)
    with pytest.raises(ValueError, match="must return an array of shape"):
        coupling.Coupling(sim, flow, drag=lambda *given: 1.0).step(1e-3)
    with pytest.raises(ValueError, match="drag law gives -1"):
        coupling.Coupling(sim, flow, drag=lambda slip, *rest: 0 * slip - 1).step(1e-3)
    with pytest.raises(ValueError, match="added_mass must be >= 0"):
        coupling.Coupling(sim, flow, added_mass=-0.5)
    both = coupling.Coupling(sim, flow)
    with pytest.raises(ValueError, match="no such|known|left"):
        both.outlet("lid")
    with pytest.raises(ValueError, match="dt must be > 0"):
        both.step(-1.0)
    flow.scheme = "bdf2"
    with pytest.raises(ValueError, match="backward_euler"):
        both.step(1e-3)

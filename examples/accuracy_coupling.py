"""Coupling: what its errors are over mesh size, kernel and time step, beside what they come from.

    ./run examples/accuracy_coupling.py --cases wake beds crossing

Flags
    --cases NAME ...   of those below (all)
    --out DIR          results.json, tables.md and pictures (out/accuracy_coupling)
    --quick            a few points of each

Cases
    wake      a grain falls in its own wake (terminal_velocity.py --two-way), element length and kernel over d, Reynolds numbers below 10: error of its
              velocity, and the wake over the slip, with drag by the flow as it is and as it would be without the grain
    beds      held periodic beds of a jittered square lattice, 0.45 of solids: error of the mean pressure gradient, hat and smooth kernels; - where the
              hat ends in void fractions below 0 or an equation that cannot be solved
    crossing  a grain, without drag, moves across a face between elements at 10 d/s: largest jump of the pressure at a node between two steps, the
              change of the void fraction in time being on

results.json: lists over points, CASE_KEY
    wake_mesh_over_d wake_kernel_over_d wake_reynolds wake_undisturbed wake_error wake_wake_over_slip wake_seconds_per_step
    beds_mesh_over_d beds_kernel_over_d beds_error beds_void_fraction_min beds_seconds_per_step
    crossing_kernel_over_d crossing_dt crossing_jump [Pa]
kernel_over_d 0: the hat.
"""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

import packed_bed
import terminal_velocity
from quicksand import coupling, fluid, grains, meshes, study

COLOURS = {0.0: "#c2452d", 1.0: "#7fb0e0", 1.5: "#1f5fa8", 3.0: "#2e7d4f"}
REYNOLDS = {2.4e-5: 0.01, 1e-4: 0.7, 2.9e-4: 10}  # of glass in water, by diameter [m]


def wake(flags):
    rows = []
    sizes, kernels = ((4.0, 10.0), (0.0, 1.5)) if flags.quick else ((2.0, 3.0, 4.0, 6.0, 8.0, 10.0), COLOURS)
    for diameter in (2.4e-5,) if flags.quick else REYNOLDS:
        for kernel in kernels:
            for size in sizes:
                for undisturbed in (False, True):
                    results, _ = terminal_velocity.fall(SimpleNamespace(
                        dim=3, diameter=diameter, density=2500.0, fluid_density=1000.0, viscosity=1e-3, drag="di_felice", dt_over_tau=1000.0, two_way=True,
                        undisturbed=undisturbed, mesh_over_d=size, kernel_over_d=kernel, out=None))
                    rows.append({"mesh_over_d": size, "kernel_over_d": kernel, "reynolds": results["reynolds"], "undisturbed": int(undisturbed), "error": results["error"],
                                 "wake_over_slip": results["wake_over_slip"], "seconds_per_step": results["wall_time"] / results["steps"]})
    return rows, {}


def bed_error(size, kernel):
    """Error of the mean gradient, least void fraction, seconds of a step; None, where void fractions or the equations break."""
    side, rows = 24, 18
    rng = np.random.default_rng(0)
    x = (np.stack(np.meshgrid(*[np.arange(rows)] * 2), -1).reshape(-1, 2) + 0.5 + rng.uniform(-0.05, 0.05, (rows**2, 2))) * side / rows - side / 2
    flags = SimpleNamespace(dim=2, diameter=1e-3, velocity=1e-4, viscosity=1e-3, density=2500.0, fluid_density=1000.0, drag="di_felice", mesh_over_d=size, element="p1p1",
                            kernel="smooth" if kernel else "hat", kernel_over_d=kernel, stiffness=1e4)
    flow, sim, eps, driven = packed_bed.periodic_bed(flags, side, x)
    both, reports = packed_bed.couple(flags, sim, flow, False), []
    try:
        packed_bed.through(both, packed_bed.time_step(flags, sim, eps), lambda: packed_bed.superficial_velocity(flow, 0), reports)
    except (ValueError, fluid.NotConverged):
        return None, None, None
    law = packed_bed.gradient(flags, eps, packed_bed.superficial_velocity(flow, 0))
    return driven / law - 1, flow.void_fraction.min(), np.median([r.fluid_time + r.exchange_time for r in reports])


def beds(flags):
    rows = []
    for kernel in (0.0, 1.5) if flags.quick else COLOURS:
        for size in (2.0, 4.0) if flags.quick else (0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0):
            error, least, seconds = bed_error(size, kernel)
            rows.append({"mesh_over_d": size, "kernel_over_d": kernel, "error": error, "void_fraction_min": least, "seconds_per_step": seconds})
    return rows, {}


def jump(kernel, dt):
    """As a grain comes to another element [Pa]."""
    d, speed = 1e-3, 1e-2
    way = 0.3 * d
    mesh = meshes.box([12 * d, 12 * d], [4, 4], origin=[-6 * d, -6 * d])
    flow = fluid.Fluid(mesh, density=1000.0, viscosity=1e-3)
    for boundary in mesh.boundary_names:
        flow.wall(boundary)
    flow.mean_pressure(0.0)
    sim = grains.Simulation(dim=2)
    sim.set_friction("grain", "grain", 0.5)
    sim.add([[-way, 0.4 * d]], d / 2, density=2500.0)
    sim.velocity = [[speed, 0.0]]
    both = coupling.Coupling(sim, flow, kernel="smooth" if kernel else "hat", kernel_radius=kernel * d, drag=lambda slip, *_: 0 * slip)
    pressures, crossing = [], round(way / (speed * dt))
    for _ in range(crossing + 5):
        both.step(dt)
        pressures.append(flow.pressure)
    return np.abs(np.diff(pressures[crossing - 5:], axis=0)).max()


def crossing(flags):
    rows = []
    for kernel in (0.0, 1.5) if flags.quick else COLOURS:
        for dt in (2e-3, 1e-3) if flags.quick else (2e-3, 1e-3, 5e-4, 2.5e-4, 1.25e-4, 6.25e-5):
            rows.append({"kernel_over_d": kernel, "dt": dt, "jump": float(jump(kernel, dt))})
    return rows, {}


def curves_of(results, case, x, y, **chosen):
    """One for each kernel."""
    column = {key: np.array([np.nan if v is None else v for v in results[f"{case}_{key}"]], float) for key in {x, y, "kernel_over_d", *chosen}}
    here = np.all([np.isclose(column[key], value) for key, value in chosen.items()], axis=0) if chosen else np.full(len(column[x]), True)
    return [("hat" if kernel == 0 else f"$r_0 = {kernel:g} d$", colour, column[x][mine], np.abs(column[y][mine]))
            for kernel, colour in COLOURS.items() if (mine := here & (column["kernel_over_d"] == kernel)).any()]


def plot(folder, results):
    if "wake_error" in results:
        slow, fast = min(results["wake_reynolds"]), max(results["wake_reynolds"])
        panels = [(f"Re = {reynolds:.2g}: error" + (", wake accounted for" if undisturbed else ""), curves_of(results, "wake", "mesh_over_d", "error", reynolds=reynolds, undisturbed=undisturbed))
                  for reynolds in sorted({slow, fast}) for undisturbed in (0, 1)]
        panels.insert(0, (f"Re = {slow:.2g}: own wake/slip", curves_of(results, "wake", "mesh_over_d", "wake_over_slip", reynolds=slow, undisturbed=0)))
        study.plot_lines(folder / "wake.png", "element length/d", "[-]", panels)
    if "beds_error" in results:
        study.plot_lines(folder / "beds.png", "element length/d", "|error| of the gradient [-]", [("jittered lattice, held", curves_of(results, "beds", "mesh_over_d", "error"))])
    if "crossing_jump" in results:
        study.plot_lines(folder / "crossing.png", "dt [s]", "jump of pressure [Pa]", [("a grain crosses a face", curves_of(results, "crossing", "dt", "jump"))])


if __name__ == "__main__":
    sys.exit(study.run_cases(__doc__, Path("out/accuracy_coupling"), [wake, beds, crossing], plot))

"""One grain falls: its terminal velocity against that of the drag law.

    ./run examples/terminal_velocity.py --diameter 1e-3 --dt-over-tau 1
    ./run examples/terminal_velocity.py --two-way --diameter 1e-4 --mesh-over-d 4 --kernel-over-d 1.5

The law says where drag is the weight less buoyancy, gamma(v) v = |rho_s - rho_f| V g; `error` is relative to that v. After max(20, 20/dt_over_tau)
steps 20 relaxation times tau = m v/(|rho_s - rho_f| V g) have passed. A disc is a column of spheres and falls as they do.

Without --two-way the fluid stays at rest, in hydrostatic pressure. With it the grain falls in the wake of its own momentum as the kernel spreads it, and
so too fast; in Stokes flow and for a Gaussian of standard deviation s, spread on the way to the fluid and averaged on the way back,
    u_wake = F/(6 pi^1.5 eta s),   of a slip F/(3 pi eta d) that is 0.28 d/s,
with s^2 = kernel^2 + what elements add. `wake_over_slip` is measured, u at the grain over v - u.
The box, of 24 d and six elements or more, falls with the grain: every step ends with the change to a frame in which the grain is at rest again. In 3D its
boundary moves as the wake in unbounded fluid does there, C. W. Oseen's flow about the grain's drag, so that no wall is felt: boxes of 24 d and 40 d give the same
to 0.1 %. Steps of 1000 tau, by default, let the wake grow to its steady state. In 2D a wake in slow flow grows with the logarithm of the box and is wider than
any: walls that fall with the grain hold it here.

Flags
    --dim 2|3            (3)
    --diameter D         [m] (1e-3)
    --density R          of the grain [kg/m^3] (2500)
    --fluid-density R    [kg/m^3] (1000)
    --viscosity E        [Pa s] (1e-3)
    --drag LAW           di_felice, gidaspow or beetstra (di_felice)
    --dt-over-tau R      time step over tau [-] (1; two-way 1000)
    --two-way            the fluid feels the grain
    --undisturbed        two-way: drag by the flow without the grain's own wake, in 3D
    --mesh-over-d R      element length at the grain [-] (4)
    --kernel-over-d R    standard deviation of the kernel [-], 0 for the hat (1.5)
    --out DIR            results.json and velocity.png (out/terminal_velocity)

results.json
    velocity velocity_exact error   at the end [m/s] [m/s] [-]
    reynolds tau                    rho_f v d/eta of the law [-]; [s]
    steps dt                        [-] [s]
    wake_over_slip                  [-]; null where the fluid is at rest, as are:
    momentum_error volume_error     largest of any step [-]
    carried_impulse                 of the last step: at the first all of it is [-]
    fluid_share exchange_share grains_share   of wall_time [-]
    wall_time dofs                  [s]; unknowns
"""

import sys
import time
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from quicksand import coupling, fluid, grains, meshes, study

GRAVITY = 9.81  # m/s^2
BOX = 24.0  # diameters, and six elements, at least


def law(flags):
    """Terminal velocity [m/s] and relaxation time [s] of a sphere."""
    solid = np.pi * flags.diameter**3 / 6
    weight = abs(flags.density - flags.fluid_density) * solid * GRAVITY

    def surplus(speed):
        return speed * coupling.drag_coefficient(flags.drag, speed, 1.0, flags.diameter, flags.fluid_density, flags.viscosity) - weight

    speed = brentq(surplus, 1e-12, 1e4, xtol=1e-18, rtol=1e-14)
    return speed, flags.density * solid * speed / weight


def oseen(x, force, speed, flags):
    """Velocity (n, 3) at x (n, 3) of a force on fluid that streams at `speed` along z, -z the direction of the force where it is positive."""
    if speed < 0:
        return -oseen(-x, -force, -speed, flags)
    # eta (laplace - 2 k d/dz) u = grad p + f delta e_z,  u = (G e_z - grad(G - G_0)/(2 k))/eta,  G = f exp(-k (r - z))/(4 pi r),  G_0 with k = 0.
    k, r = max(flags.fluid_density * speed / (2 * flags.viscosity), 1e-9 / flags.diameter), np.linalg.norm(x, axis=1)
    along, z = x / r[:, None], np.array([0.0, 0.0, 1.0])
    g0 = -force / (4 * np.pi * r)
    less = g0 * np.expm1(-k * (r - x[:, 2]))
    g = g0 + less
    return (g[:, None] * z + (g[:, None] * (along - z) + (less / (k * r))[:, None] * along) / 2) / flags.viscosity


def set_up(flags):
    d, down = flags.diameter, np.zeros(flags.dim)
    down[-1] = -GRAVITY
    size = flags.mesh_over_d * d if flags.two_way else 5 * d
    cells = 2 * max(3, int(np.ceil(BOX * d / size / 2)))
    mesh = meshes.box([cells * size] * flags.dim, [cells] * flags.dim, origin=[-cells * size / 2] * flags.dim)
    # Two-way the fluid is told no weight, and the grain its own less buoyancy: hydrostatic pressure is large, and so would be what solvers leave of it.
    flow = fluid.Fluid(mesh, density=flags.fluid_density, viscosity=flags.viscosity, gravity=0 * down if flags.two_way else down)
    frame, force = np.zeros(flags.dim), np.zeros(1)  # its velocity [m/s], and that of the grain on the fluid, downwards [N]

    def far(x, t):
        if flags.dim == 2:
            return np.tile(-frame, (len(x), 1))
        # What of it flows out through the facets, which are flat, is drawn in by a linear flow.
        corners = mesh.nodes[mesh.facets]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
        normals *= np.sign((normals * corners.mean(axis=1)).sum(axis=1))[:, None]
        out = (normals * oseen(corners.reshape(-1, 3), force[0], -frame[-1], flags).reshape(corners.shape).mean(axis=1)).sum()
        return oseen(x, force[0], -frame[-1], flags) - frame - out / mesh.volume * x * [0, 0, 1]

    for boundary in mesh.boundary_names:
        flow.wall(boundary, far)
    flow.mean_pressure(0.0)
    flow.solve_steady()  # hydrostatic
    sim = grains.Simulation(dim=flags.dim, gravity=down * (1 - flags.fluid_density / flags.density) if flags.two_way else down)
    sim.set_friction("grain", "grain", 0.5)
    place = size * np.array([[0.31, 0.17, 0.23]])[:, :flags.dim]  # neither at a node nor amid some
    sim.add(place, d / 2, density=flags.density)
    options = {"kernel": "smooth", "kernel_radius": flags.kernel_over_d * d} if flags.two_way and flags.kernel_over_d > 0 else {"kernel": "hat"}
    return flow, sim, coupling.Coupling(sim, flow, drag=flags.drag, undisturbed=flags.undisturbed, fluid_moves=flags.two_way, **options), place, frame, force


def parse_flags():
    parser = study.CommandLine(__doc__)
    parser.add_argument("--dim", type=int, choices=(2, 3), default=3)
    parser.add_argument("--diameter", type=study.number("m", above=0), default=1e-3)
    parser.add_argument("--density", type=study.number("kg/m^3", above=0), default=2500.0)
    parser.add_argument("--fluid-density", type=study.number("kg/m^3", above=0), default=1000.0)
    parser.add_argument("--viscosity", type=study.number("Pa s", above=0), default=1e-3)
    parser.add_argument("--drag", choices=coupling.LAWS, default="di_felice")
    parser.add_argument("--dt-over-tau", type=study.number("", above=0))
    parser.add_argument("--two-way", action="store_true")
    parser.add_argument("--undisturbed", action="store_true")
    parser.add_argument("--mesh-over-d", type=study.number("", above=0), default=4.0)
    parser.add_argument("--kernel-over-d", type=study.number("", at_least=0), default=1.5)
    parser.add_argument("--out", type=Path, default=Path("out/terminal_velocity"))
    flags = parser.parse_args()
    flags.dt_over_tau = flags.dt_over_tau or (1000.0 if flags.two_way else 1.0)
    if flags.density == flags.fluid_density:
        parser.error(f"argument --density: must not be that of the fluid, {flags.fluid_density:g} kg/m^3: such a grain does not fall")
    if flags.undisturbed and not (flags.two_way and flags.dim == 3):
        parser.error("argument --undisturbed: needs --two-way and --dim 3: a fluid at rest has no wake, that of a disc is as wide as the box")
    return parser, flags


def fall(flags):
    """The results, and the velocity after each step (n,) [m/s]."""
    flow, sim, both, place, frame, force = set_up(flags)
    exact, tau = law(flags)
    dt, steps = flags.dt_over_tau * tau, max(20, int(np.ceil(20 / flags.dt_over_tau)))
    speeds, reports, wake = [], [], None
    start = time.perf_counter()
    for _ in range(steps):
        reports.append(both.step(dt))
        if flags.two_way:
            u, v = both.fluid_velocity[0, -1], sim.velocity[0, -1]
            wake = (u + frame[-1]) / (v - u)
            force[0] = both.drag_force[0, -1]
            frame += sim.velocity[0]
            flow.set_velocity(flow.velocity - sim.velocity[0])
            sim.velocity = np.zeros_like(sim.velocity)
        speeds.append(abs(frame[-1] if flags.two_way else sim.velocity[0, -1]))
        sim.position = place
    seconds = time.perf_counter() - start
    results = {name: value for name, value in vars(flags).items() if name != "out"}
    results |= {"velocity": speeds[-1], "velocity_exact": exact, "error": speeds[-1] / exact - 1, "reynolds": flags.fluid_density * exact * flags.diameter / flags.viscosity,
                "tau": tau, "steps": steps, "dt": dt, "wake_over_slip": wake, "momentum_error": None, "volume_error": None, "carried_impulse": None,
                "fluid_share": None, "exchange_share": None, "grains_share": None, "wall_time": seconds, "dofs": flow.dofs}
    if flags.two_way:
        results |= {name: max(getattr(r, name) for r in reports) for name in ("momentum_error", "volume_error")} | {"carried_impulse": reports[-1].carried_impulse}
        results |= {f"{part}_share": sum(getattr(r, f"{part}_time") for r in reports) / seconds for part in ("fluid", "exchange", "grains")}
    return results, np.array(speeds)


def main():
    parser, flags = parse_flags()
    with parser.user_errors(ValueError, OSError, MemoryError, fluid.NotConverged):
        flags.out.mkdir(parents=True, exist_ok=True)
        results, speeds = fall(flags)
        study.write_results(flags.out / "results.json", results)
    exact, t = results["velocity_exact"], np.arange(len(speeds) + 1) * flags.dt_over_tau
    study.plot_along(flags.out / "velocity.png", "$t/\\tau$ [-]", [("$v$ [m/s]", [("law", study.FAINT, t[[0, -1]], [exact, exact]), ("grain", study.BLUE, t, np.array([0.0, *speeds]))])])
    units = {"velocity": "m/s", "error": "-", "reynolds": "-", "tau": "s", "wake_over_slip": "-", "momentum_error": "-", "carried_impulse": "-", "dofs": "", "wall_time": "s"}
    study.print_summary(f"One grain falls in {flags.dim}D, the fluid {'feels it' if flags.two_way else 'at rest'}", results, units,
                        {"velocity": f"{exact:.6g}", "error": "0"}, "law", digits=6)
    return 0


if __name__ == "__main__":
    sys.exit(main())

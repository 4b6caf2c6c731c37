"""Grains settle in a fluid: a dense block in a closed box, or everywhere at once, as J. F. Richardson and W. N. Zaki measured it.

    ./run examples/sedimentation.py --dim 2
    ./run examples/sedimentation.py --homogeneous --viscosity 1e-3 --diameter 1e-3

A block: random grains fill the upper part of a box that gmsh has meshed, its walls are walls of fluid and grains both, and nothing else happens: they fall,
the fluid goes up between and around them, and a bed grows. `height` is that of the centre of mass over the floor, `front_speed` the speed of the
lowest grains (their 2 % quantile) from an eighth to a half of their way down.

--homogeneous: a periodic box of grains, evenly spread, in which gravity on fluid and grains is such that all forces add up to zero. U, the speed of
the grains' mean against the mixture's volume flux, is taken at solid fractions of 0.05 to 0.4 once it is steady: U = U_t eps^n. n is the slope of ln U over ln eps, in 3D against n = 4.65 (Re < 0.2), 4.35 Re^-0.03 (< 1), 4.45 Re^-0.1 (< 500), 2.39, Re that of a grain alone. In 2D eps is an area
fraction, and n lower: 3.4 to 2.0.

Flags
    --dim 2|3          (2; homogeneous 3)
    --diameter D       [m] (1e-3)
    --density R        of the grains [kg/m^3] (2500)
    --fluid-density R  [kg/m^3] (1000)
    --viscosity E      [Pa s] (0.01)
    --phi P            solid fraction of the block [-] (0.5; 3D 0.4)
    --drag LAW         di_felice, gidaspow or beetstra (di_felice)
    --mesh-over-d R    element length [-] (3)
    --kernel-over-d R  standard deviation of the kernel [-] (1.5)
    --homogeneous      Richardson and Zaki
    --seed N           (0)
    --quick            a block half as wide and high
    --out DIR          results.json, sedimentation.png (out/sedimentation)

results.json
    time height                       at each step [s] [m] (lists); null with --homogeneous
    front_speed front_speed_law       of a block, and of the law at its phi [m/s]; null with --homogeneous
    solid_fractions speeds            [-] [m/s] (lists); null without, as all below to reynolds
    exponent exponent_richardson_zaki exponent_error   [-]
    reynolds                          of a grain alone [-]
    void_fraction_min                 at nodes, of any step [-]
    max_overlap                       of grains, over d [-]
    momentum_error volume_error       largest of a step after the first [-]
    carried_impulse                   median of steps [-]
    fluid_share exchange_share grains_share       of wall_time [-]
    grains steps dt                   (homogeneous: of the last solid fraction) [-] [-] [s]
    unconverged_steps                 sub-steps of grains above their tolerance [-]
    wall_time dofs                    [s]; unknowns
"""

import sys
import time
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from packed_bed import random_bed, solid, spheres_void_fraction
from quicksand import coupling, fluid, grains, meshes, study

GRAVITY = 9.81  # m/s^2


def settling_speed(flags, eps):
    """Of the law, against the mixture: drag is eps times weight less buoyancy, U = eps times the slip [m/s]."""
    seen = eps if flags.dim == 3 else spheres_void_fraction(eps)
    weight = eps * (flags.density - flags.fluid_density) * GRAVITY * np.pi * flags.diameter**3 / 6

    def surplus(slip):
        return slip * coupling.drag_coefficient(flags.drag, slip, seen, flags.diameter, flags.fluid_density, flags.viscosity) - weight

    return eps * brentq(surplus, 1e-12, 1e4, xtol=1e-18)


def richardson_zaki(reynolds):
    return 4.65 if reynolds < 0.2 else 4.35 * reynolds**-0.03 if reynolds < 1 else 4.45 * reynolds**-0.1 if reynolds < 500 else 2.39


def balances(reports, seconds):
    found = {name: max(getattr(r, name) for r in reports[1:]) for name in ("momentum_error", "volume_error")} | {"carried_impulse": float(np.median([r.carried_impulse for r in reports]))}
    found |= {f"{part}_share": sum(getattr(r, f"{part}_time") for r in reports) / seconds for part in ("fluid", "exchange", "grains")}
    return found | {"max_overlap": max(r.grains.max_overlap for r in reports), "unconverged_steps": sum(r.grains.unconverged for r in reports), "steps": len(reports), "wall_time": seconds}


def couple(flags, sim, flow):
    sim.set_friction("grain", "grain", 0.5), sim.set_friction("grain", "wall", 0.5)
    return coupling.Coupling(sim, flow, kernel_radius=flags.kernel_over_d * flags.diameter, drag=flags.drag)


def run_block(flags):
    d, dim = flags.diameter, flags.dim
    width, height, block = (24, 60, 30) if dim == 2 else (9, 36, 16)
    if flags.quick:
        width, height, block = width / 2, height / 2, block / 2
    down = [0.0] * (dim - 1) + [-GRAVITY]
    lengths = [width * d] * (dim - 1) + [height * d]
    mesh = meshes.box(lengths, size=flags.mesh_over_d * d)
    flow = fluid.Fluid(mesh, density=flags.fluid_density, viscosity=flags.viscosity, gravity=down)
    for boundary in mesh.boundary_names:
        flow.wall(boundary)
    flow.mean_pressure(0.0)
    sim = grains.Simulation(dim=dim, gravity=down)
    x, _, _ = random_bed([width - 1] * (dim - 1) + [block], flags.phi * width ** (dim - 1) / (width - 1) ** (dim - 1), flags.seed)
    x += [width / 2] * (dim - 1) + [height - 1 - block / 2]
    both = couple(flags, sim, flow)
    sim.add(x * d, d / 2, density=flags.density)
    sim.walls(mesh, mesh.boundary_names)
    eps = 1 - flags.phi
    law = settling_speed(flags, eps)
    dt = 0.05 * d / law
    sim.tolerance, sim.max_sweeps, sim.accept_unconverged = 1e-3, 2000, True  # counted
    heights, fronts, reports, lowest = [], [], [], 1.0
    start = time.perf_counter()
    for _ in range(round(1.2 * (height - block) * d / law / dt)):
        reports.append(both.step(dt))
        y = sim.position[:, -1]
        heights.append(y.mean()), fronts.append(np.quantile(y, 0.02))
        lowest = min(lowest, flow.void_fraction.min())
    seconds = time.perf_counter() - start
    t, fronts = dt * np.arange(1, len(reports) + 1), np.array(fronts)
    way = fronts[0] - d / 2
    chosen = (fronts < fronts[0] - way / 8) & (fronts > fronts[0] - way / 2)
    speed = -np.polyfit(t[chosen], fronts[chosen], 1)[0] if chosen.sum() > 2 else None
    return balances(reports, seconds) | {"time": t, "height": np.array(heights), "front_speed": speed, "front_speed_law": law, "void_fraction_min": lowest, "grains": sim.count, "dt": dt,
                                         "dofs": flow.dofs}, [("height/d", [("centre of mass", study.BLUE, t, np.array(heights) / d), ("front", study.RED, t, fronts / d)])]


def run_homogeneous(flags):
    d, dim = flags.diameter, flags.dim
    side = 12 if dim == 3 else 24

    def gravity(g):
        return [0.0] * (dim - 1) + [g]

    alone = settling_speed(flags, 1.0 - 1e-9)
    reynolds = flags.fluid_density * alone * d / flags.viscosity
    phis, speeds, reports, seconds, lowest = (0.05, 0.1, 0.2, 0.3, 0.4), [], [], 0.0, 1.0
    for phi in phis:
        x, _, _ = random_bed([side] * dim, phi, flags.seed)
        length = side * d
        phi = len(x) * solid(flags) / length**dim
        mesh = meshes.box([length] * dim, [max(2, round(side / flags.mesh_over_d))] * dim, periodic=[True] * dim, origin=[-length / 2] * dim)
        # Weight less that of the mixture.
        mixture = phi * flags.density + (1 - phi) * flags.fluid_density
        flow = fluid.Fluid(mesh, density=flags.fluid_density, viscosity=flags.viscosity, gravity=gravity(-GRAVITY * (1 - mixture / flags.fluid_density)))
        flow.mean_pressure(0.0)
        sim = grains.Simulation(dim=dim, period=[length] * dim, gravity=gravity(-GRAVITY * (1 - mixture / flags.density)))
        both = couple(flags, sim, flow)
        sim.add(x * d, d / 2, density=flags.density)
        law = settling_speed(flags, 1 - phi)
        tau = flags.density / (flags.density - flags.fluid_density) * law / GRAVITY
        dt = min(2 * tau, 0.1 * d / law)
        speed = 0.0
        start = time.perf_counter()
        for _ in range(2000):
            reports.append(both.step(dt))
            lowest = min(lowest, flow.void_fraction.min())
            before, v = speed, sim.velocity[:, -1].mean()
            # Momentum of the mixture is zero: <eps u> from that of the grains.
            speed = -(v - phi * v + phi * flags.density / flags.fluid_density * v)
            if abs(speed - before) < 1e-4 * speed * min(1, dt / tau):
                break
        seconds += time.perf_counter() - start
        speeds.append(speed)
    eps = 1 - np.array(phis)
    exponent = np.polyfit(np.log(eps), np.log(speeds), 1)[0]
    expected = richardson_zaki(reynolds)
    return balances(reports, seconds) | {"solid_fractions": phis, "speeds": speeds, "exponent": exponent, "exponent_richardson_zaki": expected, "exponent_error": exponent - expected,
                                         "reynolds": reynolds, "void_fraction_min": lowest, "grains": sim.count, "dt": dt, "dofs": flow.dofs}, [
        ("$U/U_t$", [("Richardson, Zaki", study.FAINT, np.array(phis), eps**expected), ("grains", study.BLUE, np.array(phis), np.array(speeds) / alone)])]


def parse_flags():
    parser = study.CommandLine(__doc__)
    parser.add_argument("--dim", type=int, choices=(2, 3))
    parser.add_argument("--diameter", type=study.number("m", above=0), default=1e-3)
    parser.add_argument("--density", type=study.number("kg/m^3", above=0), default=2500.0)
    parser.add_argument("--fluid-density", type=study.number("kg/m^3", above=0), default=1000.0)
    parser.add_argument("--viscosity", type=study.number("Pa s", above=0), default=0.01)
    parser.add_argument("--phi", type=study.number("", above=0))
    parser.add_argument("--drag", choices=coupling.LAWS, default="di_felice")
    parser.add_argument("--mesh-over-d", type=study.number("", above=0), default=3.0)
    parser.add_argument("--kernel-over-d", type=study.number("", above=0), default=1.5)
    parser.add_argument("--homogeneous", action="store_true")
    parser.add_argument("--seed", type=study.whole(at_least=0), default=0)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("out/sedimentation"))
    flags = parser.parse_args()
    flags.dim = flags.dim or (3 if flags.homogeneous else 2)
    flags.phi = flags.phi or (0.5 if flags.dim == 2 else 0.4)
    if flags.density <= flags.fluid_density:
        parser.error(f"argument --density: must be above that of the fluid, {flags.fluid_density:g} kg/m^3, for grains that settle, got {flags.density:g}")
    if flags.phi > (0.75 if flags.dim == 2 else 0.55):
        parser.error(f"argument --phi: must be at most 0.75 in 2D and 0.55 in 3D, for grains at random that do not overlap, got {flags.phi:g}")
    return parser, flags


def main():
    parser, flags = parse_flags()
    with parser.user_errors(ValueError, OSError, MemoryError, fluid.NotConverged, grains.NotConverged):
        flags.out.mkdir(parents=True, exist_ok=True)
        found, panels = (run_homogeneous if flags.homogeneous else run_block)(flags)
        results = {name: value for name, value in vars(flags).items() if name not in ("out", "quick")}
        results |= dict.fromkeys(("time", "height", "front_speed", "front_speed_law", "solid_fractions", "speeds", "exponent", "exponent_richardson_zaki", "exponent_error", "reynolds"))
        results |= found
        study.write_results(flags.out / "results.json", results)
    study.plot_along(flags.out / "sedimentation.png", "$\\phi$ [-]" if flags.homogeneous else "$t$ [s]", panels)
    units = {"exponent": "-", "reynolds": "-"} if flags.homogeneous else {"front_speed": "m/s"}
    units |= {"void_fraction_min": "-", "max_overlap": "-", "momentum_error": "-", "volume_error": "-", "carried_impulse": "-", "fluid_share": "-", "exchange_share": "-", "grains_share": "-",
              "grains": "", "steps": "", "dofs": "", "wall_time": "s"}
    references = {"exponent": f"{results['exponent_richardson_zaki']:.4g}"} if flags.homogeneous else {"front_speed": f"{results['front_speed_law']:.4g}"}
    study.print_summary(f"{'Homogeneous settling' if flags.homogeneous else 'A block settles'} in {flags.dim}D", results, units, references | {"momentum_error": "0", "volume_error": "0"},
                        "law", digits=5)
    return 0


if __name__ == "__main__":
    sys.exit(main())

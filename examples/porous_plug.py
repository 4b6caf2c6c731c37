"""Flow through a plug of grains at rest: the flux through every section is that of the inflow.

    ./run examples/porous_plug.py --element p2p1 --ramp-elements 3 --beta 1

Channel 4 m x 1 m between smooth walls (slip), uniform inflow of 1 m/s, density 1 kg/m^3, viscosity 0.1 Pa s. Between x = 1.5 m and 2.5 m the void
fraction is 0.4 and the fluid feels -beta u, both on smooth ramps (3 s^2 - 2 s^3) to 1 and 0 outside: what is left of a step by a kernel that averages
grains. The exact flow is one-dimensional:
    eps u = 1 m/s,   dp/dx = 2 eta u'' - rho u u' - beta u/eps
Where the void fraction has a kink, u' jumps and so does this pressure, by 2 eta times as much: straight ramps would measure how well continuous
elements make jumps.

Flags
    --element NAME      p1p1 or p2p1 (p2p1)
    --ramp-elements N   length of a ramp, in elements (3)
    --beta B            beta h^2/eta in the plug, h the length of elements: 135 for grains of diameter h by Ergun's equation [-] (1)
    --size H            element length [m] (1/16)
    --out DIR           where results.json and axis.png go (out/porous_plug)

results.json
    flux_error_max                     |int eps u . n / inflow - 1|, the largest of sections half an element apart [-]
    x_flux_error_max                   where [m]
    pressure_drop pressure_drop_exact  from inflow to outflow, on the axis [Pa]
    dofs wall_time                     unknowns; seconds in the solver
"""

import sys
import time
from pathlib import Path

import numpy as np

from quicksand import fluid, meshes, study

LENGTH, HEIGHT = 4.0, 1.0  # m
PLUG = 1.5, 2.5  # m
EPS, DENSITY, VISCOSITY, SPEED = 0.4, 1.0, 0.1, 1.0  # in the plug [-]; kg/m^3, Pa s, m/s


def filled(x, ramp):
    """Share of the plug's grains at x: 0 to 1."""
    s = np.clip(1 + np.minimum(x - PLUG[0], PLUG[1] - x) / ramp, 0, 1)
    return s * s * (3 - 2 * s)


def void_fraction(x, ramp):
    return 1 - (1 - EPS) * filled(x, ramp)


def exact(x, ramp, beta):
    """Velocity and pressure at ascending x, 0 Pa at the last."""
    u = SPEED / void_fraction(x, ramp)
    drag = beta * filled(x, ramp) * u**2 / SPEED
    lost = np.concatenate([[0.0], np.cumsum((drag[1:] + drag[:-1]) / 2 * np.diff(x))])
    p = 2 * VISCOSITY * np.gradient(u, x) - DENSITY * u**2 / 2 - lost
    return u, p - p[-1]


def set_up(element, size, ramp, beta):
    mesh = meshes.channel(LENGTH, HEIGHT, size)
    flow = fluid.Fluid(mesh, density=DENSITY, viscosity=VISCOSITY, element=element)
    flow.inflow("inflow", (SPEED, 0.0))
    flow.slip("walls")
    flow.outflow("outflow")
    flow.void_fraction = lambda x, t: void_fraction(x[:, 0], ramp)
    flow.reaction(beta=lambda x, t: beta * filled(x[:, 0], ramp))
    return mesh, flow


def section_fluxes(mesh, flow, element, ramp):
    """x, and int eps u . n, of the lines of the grid and halfway between them."""
    lines = np.unique(mesh.nodes[:, 0])
    x = np.sort(np.concatenate([lines, (lines[1:] + lines[:-1]) / 2]))
    eps = void_fraction(x, ramp)
    if element == "p1p1":  # as elements have it
        eps[1::2] = (eps[:-1:2] + eps[2::2]) / 2
    # On these sections triangles begin and end at multiples of half a cell. In between eps u is a parabola at most: two Gauss points are exact.
    halves = 2 * (len(np.unique(mesh.nodes[:, 1])) - 1)
    y = ((np.arange(halves) + 0.5)[:, None] + np.array([-0.5, 0.5]) / np.sqrt(3)).ravel() * HEIGHT / halves
    u = flow.probe(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2))["velocity"][:, 0]
    return x, eps * u.reshape(len(x), len(y)).mean(axis=1) * HEIGHT


def parse_flags():
    parser = study.CommandLine(__doc__)
    parser.add_argument("--element", choices=("p1p1", "p2p1"), default="p2p1")
    parser.add_argument("--ramp-elements", type=study.number("elements", above=0), default=3.0)
    parser.add_argument("--beta", type=study.number("", at_least=0), default=1.0)
    parser.add_argument("--size", type=study.number("m", above=0), default=1 / 16)
    parser.add_argument("--out", type=Path, default=Path("out/porous_plug"))
    flags = parser.parse_args()
    if flags.ramp_elements * flags.size > PLUG[0]:
        parser.error(f"argument --ramp-elements: ramps must begin in the channel, at most {PLUG[0] / flags.size:.4g} elements long, got {flags.ramp_elements:g}")
    return parser, flags


def main():
    parser, flags = parse_flags()
    flags.size = HEIGHT / max(1, round(HEIGHT / flags.size))
    ramp, beta = flags.ramp_elements * flags.size, flags.beta * VISCOSITY / flags.size**2
    with parser.user_errors():
        flags.out.mkdir(parents=True, exist_ok=True)
        mesh, flow = set_up(flags.element, flags.size, ramp, beta)
    start = time.perf_counter()
    with parser.user_errors(fluid.NotConverged):
        flow.solve_steady()
    seconds = time.perf_counter() - start
    x, flux = section_fluxes(mesh, flow, flags.element, ramp)
    error = flux / (SPEED * HEIGHT) - 1
    fine = np.linspace(0, LENGTH, 8001)
    u_exact, p_exact = exact(fine, ramp, beta)
    axis = flow.probe(np.column_stack([fine, np.full_like(fine, HEIGHT / 2)]))
    results = {"element": flags.element, "ramp_elements": flags.ramp_elements, "beta": flags.beta, "size": flags.size,
               "flux_error_max": np.abs(error).max(), "x_flux_error_max": x[np.abs(error).argmax()],
               "pressure_drop": axis["pressure"][0] - axis["pressure"][-1], "pressure_drop_exact": p_exact[0], "dofs": flow.dofs, "wall_time": seconds}
    with parser.user_errors(OSError):
        study.write_results(flags.out / "results.json", results)
    study.plot_along(flags.out / "axis.png", "$x$ [m]", [
        (r"$\varepsilon$ [-]", [("", study.BLUE, fine, void_fraction(fine, ramp))]),
        ("$u$ [m/s]", [("exact", study.FAINT, fine, u_exact), (flags.element, study.BLUE, fine, axis["velocity"][:, 0])]),
        ("$p$ [Pa]", [("exact", study.FAINT, fine, p_exact), (flags.element, study.BLUE, fine, axis["pressure"])]),
        ("flux / inflow - 1 [-]", [("", study.RED, x, error)])])
    study.print_summary(f"Through a porous plug, {flags.element}, ramps over {flags.ramp_elements:g} elements, beta h^2/eta {flags.beta:g}", results,
                        {"flux_error_max": "-", "x_flux_error_max": "m", "pressure_drop": "Pa", "dofs": "", "wall_time": "s"},
                        {"flux_error_max": "0", "pressure_drop": f"{p_exact[0]:.6g}"}, "exact", digits=6)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Flow around a cylinder in a channel, the benchmark of Schaefer and Turek: steady (2D-1), and with its vortex street (2D-2).

    ./run examples/cylinder_in_channel.py --case 2D-1 --element p2p1

M. Schaefer and S. Turek, "Benchmark computations of laminar flow around a cylinder" (1996): channel 2.2 m x 0.41 m, cylinder of diameter
D = 0.1 m around (0.2, 0.2) m, viscosity 0.001 Pa s, density 1 kg/m^3, parabolic inflow of mean velocity U = 2/3 u_max: 2D-1 u_max 0.3 m/s, Reynolds
number U D/nu = 20; 2D-2 1.5 m/s and 100. 2D-2 starts from rest, with a gust across the wake that the vortices grow from, and is measured over
its last five periods. Elements have straight sides: of the polygon in place of the circle come errors of order size^2. The steady lift is 0.2 % of the
drag: with p1p1 and 60 000 unknowns it is known to a tenth. At the default size and step the vortices' lift has errors of 1 % to 2 % of the mesh and
of the step, of opposite sign.

Flags
    --case NAME     2D-1 or 2D-2 (2D-1)
    --element NAME  p1p1 or p2p1 (p2p1)
    --size H        length of elements at the cylinder [m] (0.005)
    --dt DT         time step of 2D-2, BDF2 [s] (0.005)
    --t-end T       end of 2D-2 [s] (7)
    --quick         --size 0.01, and for 2D-2 --dt 0.01 --t-end 6
    --out DIR       where results.json, flow.png and, for 2D-2, forces.png go (out/cylinder_in_channel)

results.json
    c_d c_l         2 F/(rho U^2 D) of drag and lift on the cylinder [-]; 2D-2: their maxima
    dp              pressure before the cylinder, at (0.15, 0.2) m, less that behind, at (0.25, 0.2) m [Pa]; 2D-2: half a period after a maximum of c_l
    strouhal        f D/U of the lift [-]; 2D-1: null
    c_l_drift       2D-2: largest difference between the last five maxima of the lift over the last of them [-]; 2D-1: null
    dofs wall_time  unknowns; seconds in the solver
"""

import sys
import time
from pathlib import Path

import numpy as np

from quicksand import fluid, meshes, study

HEIGHT, DIAMETER, VISCOSITY = 0.41, 0.1, 1e-3
PEAK = {"2D-1": 0.3, "2D-2": 1.5}  # of the inflow [m/s]
# 2D-1: to the last digit by spectral methods, G. Nabh (1998); 2D-2: the intervals of Schaefer and Turek.
REFERENCES = {"2D-1": {"c_d": "5.57953523", "c_l": "0.01061895", "dp": "0.11752017"},
              "2D-2": {"c_d": "3.22 - 3.24", "c_l": "0.99 - 1.01", "dp": "2.46 - 2.50", "strouhal": "0.295 - 0.305"}}
PERIODS = 5


def set_up(case, element, size):
    mesh = meshes.cylinder_in_channel(size)
    flow = fluid.Fluid(mesh, density=1.0, viscosity=VISCOSITY, element=element)
    flow.inflow("inflow", lambda x, t: np.column_stack([4 * PEAK[case] * x[:, 1] * (HEIGHT - x[:, 1]) / HEIGHT**2, np.zeros(len(x))]))
    flow.wall("walls")
    flow.wall("cylinder")
    flow.outflow("outflow")
    return mesh, flow


def measure(case, flow):
    """c_d, c_l, dp."""
    mean = 2 / 3 * PEAK[case]
    before, behind = flow.probe([[0.15, 0.2], [0.25, 0.2]])["pressure"]
    return *(2 * flow.force("cylinder") / (mean**2 * DIAMETER)), before - behind


def steady(flow):
    flow.solve_steady()
    return dict(zip(("c_d", "c_l", "dp"), measure("2D-1", flow))) | {"strouhal": None, "c_l_drift": None}


def peaks(t, series):
    """Times and values of the maxima, of parabolas through three samples."""
    k = np.flatnonzero((series[1:-1] > series[:-2]) & (series[1:-1] >= series[2:])) + 1
    slope, curvature = (series[k + 1] - series[k - 1]) / 2, series[k + 1] - 2 * series[k] + series[k - 1]
    return t[k] - slope / curvature * (t[1] - t[0]), series[k] - slope**2 / (2 * curvature)


def shedding(t, c_d, c_l, dp):
    """What is compared, from the last periods of the series."""
    at, highest = peaks(t, c_l)
    if len(at) < PERIODS + 1 or highest[-1] < 0.1:
        raise fluid.NotConverged(f"shedding: {PERIODS} periods of vortices must be over at t = {t[-1]:.4g} s, lift has {len(at)} maxima; raise --t-end")
    at, highest = at[-PERIODS - 1:], highest[-PERIODS - 1:]
    period = (at[-1] - at[0]) / PERIODS
    at_drag, highest_drag = peaks(t, c_d)
    return {"c_d": highest_drag[at_drag > at[0]].max(), "c_l": highest[1:].max(), "dp": np.interp(at[:-1] + period / 2, t, dp).mean(),
            "strouhal": DIAMETER / (period * 2 / 3 * PEAK["2D-2"]), "c_l_drift": np.ptp(highest[1:]) / highest[-1]}


def unsteady(flow, dt, t_end):
    """Also the series t, c_d, c_l, dp."""
    x = flow.nodes - (0.35, 0.2)
    flow.set_velocity(np.column_stack([np.zeros(len(x)), 0.2 * PEAK["2D-2"] * np.exp(-np.sum(x**2, axis=1) / DIAMETER**2)]))
    rows, printed = [], time.perf_counter()
    for _ in range(round(t_end / dt)):
        flow.step(dt)
        rows.append((flow.time, *measure("2D-2", flow)))
        if time.perf_counter() > printed + 10:
            printed = time.perf_counter()
            print(f"t = {flow.time:.3f} s of {t_end:g} s: c_d {rows[-1][1]:.4f}, c_l {rows[-1][2]:+.4f}", flush=True)
    series = np.array(rows).T
    return shedding(*series), series


def vorticity(mesh, velocity):
    """At the nodes, from the elements around each, by area."""
    x, u = mesh.nodes[mesh.elements], velocity[mesh.elements]
    (ax, ay), (bx, by) = (x[:, 1] - x[:, 0]).T, (x[:, 2] - x[:, 0]).T
    (au, av), (bu, bv) = (u[:, 1] - u[:, 0]).T, (u[:, 2] - u[:, 0]).T
    area, curl = ax * by - ay * bx, av * by - bv * ay + au * bx - bu * ax  # twice the area; and times dv/dx - du/dy
    sums = [np.bincount(mesh.elements.ravel(), np.repeat(values, 3), len(mesh.nodes)) for values in (curl, area)]
    return sums[0] / sums[1]


def parse_flags():
    parser = study.CommandLine(__doc__)
    parser.add_argument("--case", choices=tuple(PEAK), default="2D-1")
    parser.add_argument("--element", choices=("p1p1", "p2p1"), default="p2p1")
    parser.add_argument("--size", type=study.number("m", above=0))
    parser.add_argument("--dt", type=study.number("s", above=0))
    parser.add_argument("--t-end", type=study.number("s", above=0))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("out/cylinder_in_channel"))
    flags = parser.parse_args()
    for name, full, quick in (("size", 0.005, 0.01), ("dt", 0.005, 0.01), ("t_end", 7.0, 6.0)):
        if getattr(flags, name) is None:
            setattr(flags, name, quick if flags.quick else full)
    return parser, flags


def main():
    parser, flags = parse_flags()
    with parser.user_errors():
        flags.out.mkdir(parents=True, exist_ok=True)
        mesh, flow = set_up(flags.case, flags.element, flags.size)
    start = time.perf_counter()
    with parser.user_errors(fluid.NotConverged):
        if flags.case == "2D-1":
            found, series = steady(flow), None
        else:
            found, series = unsteady(flow, flags.dt, flags.t_end)
    results = {"case": flags.case, "element": flags.element, "size": flags.size, "dt": flags.dt if flags.case == "2D-2" else None, **found,
               "dofs": flow.dofs, "wall_time": time.perf_counter() - start}
    with parser.user_errors(OSError):
        study.write_results(flags.out / "results.json", results)
    velocity, title = flow.velocity[:len(mesh.nodes)], f"{flags.case}, {flags.element}, elements of {flags.size:g} m at the cylinder"
    if series is None:
        speed = np.linalg.norm(velocity, axis=1)
        study.plot_flow(flags.out / "flow.png", mesh, [("speed [m/s]", speed, None, velocity), ("$p$ [Pa]", flow.pressure, None, None)],
                        ((0, 0.9), (0, HEIGHT)), title)
    else:
        t, c_d, c_l, dp = series[:, series[0] > 0.5]  # without the blow of starting at once
        study.plot_flow(flags.out / "flow.png", mesh, [("vorticity [1/s]", vorticity(mesh, velocity), 60.0, None)], title=f"{title}, t = {flow.time:.3g} s")
        study.plot_series(flags.out / "forces.png", t, [("$c_D$", c_d, found["c_d"]), ("$c_L$", c_l, found["c_l"]), (r"$\Delta p$ [Pa]", dp, found["dp"])],
                          t[-1] - PERIODS * DIAMETER / (found["strouhal"] * 2 / 3 * PEAK["2D-2"]), "maxima; pressure: half a period after those of $c_L$")
    study.print_summary(f"Cylinder in a channel, {title}", results,
                        {"c_d": "-", "c_l": "-", "dp": "Pa"} | ({"strouhal": "-", "c_l_drift": "-"} if series is not None else {}) | {"dofs": "", "wall_time": "s"},
                        REFERENCES[flags.case], "reference", digits=6)
    return 0


if __name__ == "__main__":
    sys.exit(main())

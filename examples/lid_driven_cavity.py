"""Flow in a square cavity under a sliding lid, against the spectral solutions of Botella and Peyret.

    ./run examples/lid_driven_cavity.py --reynolds 1000 --element p2p1

Side 1 m, the lid (top) moves along x at 1 m/s and takes the corners with it, density 1 kg/m^3, viscosity 1/Re Pa s: u, v and lengths are those of
the dimensionless problem. The steady flow by Newton's method, in stages of rising Reynolds number where it does not find it at once.
O. Botella and R. Peyret, Computers & Fluids 27 (1998), for Reynolds numbers of 100 and 1000.

Flags
    --reynolds RE   (1000)
    --element NAME  p1p1 or p2p1 (p2p1)
    --size H        of the cells of the grid, each cut into two triangles [m] (1/48)
    --out DIR       where results.json and flow.png go (out/lid_driven_cavity)

results.json
    u_min y_u_min   lowest horizontal velocity on the vertical centre line, and where [m/s] [m]
    v_min x_v_min   lowest and
    v_max x_v_max   highest vertical velocity on the horizontal centre line, and where
    stages          Reynolds numbers on the way
    dofs wall_time  unknowns; seconds in the solver
"""

import sys
import time
from pathlib import Path

import numpy as np

from quicksand import fluid, meshes, study

REFERENCES = {100: {"u_min": "-0.2140424", "y_u_min": "0.4581", "v_min": "-0.2538030", "v_max": "0.1795728"},
              1000: {"u_min": "-0.3885698", "y_u_min": "0.1717", "v_min": "-0.5270771", "x_v_min": "0.9092", "v_max": "0.3769447", "x_v_max": "0.1578"}}
MOST_TRIES = 20


def set_up(mesh, element, reynolds):
    flow = fluid.Fluid(mesh, density=1.0, viscosity=1 / reynolds, element=element)
    for side in ("left", "right", "bottom"):
        flow.wall(side)
    flow.wall("top", (1.0, 0.0))
    flow.mean_pressure(0.0)
    return flow


def solve(mesh, element, reynolds):
    """The steady flow, and the Reynolds numbers on the way. What is not found is tried halfway, on a logarithmic scale, from the last that was."""
    stages, attempt, start = [], reynolds, None
    for _ in range(MOST_TRIES):
        flow = set_up(mesh, element, attempt)
        flow.max_newton = 15
        if start is not None:
            flow.set_velocity(start.velocity)
            flow.set_pressure(start.pressure)
        try:
            flow.solve_steady()
        except fluid.NotConverged:
            attempt = np.sqrt(attempt * (stages[-1] if stages else 1.0))
            continue
        stages.append(float(attempt))
        if attempt == reynolds:
            return flow, stages
        start, attempt = flow, reynolds
    raise fluid.NotConverged(f"solve: no steady flow found in {MOST_TRIES} tries, the last Reynolds number with one is {stages[-1] if stages else 0:.4g} of {reynolds:g}; lower --size")


def lowest(s, f):
    """Value and place of the lowest of samples, of the parabola through it and its neighbours."""
    k = int(np.clip(np.argmin(f), 1, len(f) - 2))
    slope, curvature = (f[k + 1] - f[k - 1]) / 2, f[k + 1] - 2 * f[k] + f[k - 1]
    return f[k] - slope**2 / (2 * curvature), s[k] - slope / curvature * (s[1] - s[0])


def centre_lines(flow):
    """Places, u on the vertical and v on the horizontal centre line."""
    s = np.linspace(0, 1, 2001)
    half = np.full_like(s, 0.5)
    return s, flow.probe(np.column_stack([half, s]))["velocity"][:, 0], flow.probe(np.column_stack([s, half]))["velocity"][:, 1]


def parse_flags():
    parser = study.CommandLine(__doc__)
    parser.add_argument("--reynolds", type=study.number("", above=0), default=1000.0)
    parser.add_argument("--element", choices=("p1p1", "p2p1"), default="p2p1")
    parser.add_argument("--size", type=study.number("m", above=0), default=1 / 48)
    parser.add_argument("--out", type=Path, default=Path("out/lid_driven_cavity"))
    return parser, parser.parse_args()


def main():
    parser, flags = parse_flags()
    cells = max(2, round(1 / flags.size))
    with parser.user_errors():
        flags.out.mkdir(parents=True, exist_ok=True)
        mesh = meshes.box([1.0, 1.0], counts=[cells, cells])
    start = time.perf_counter()
    with parser.user_errors(fluid.NotConverged):
        flow, stages = solve(mesh, flags.element, flags.reynolds)
    seconds = time.perf_counter() - start
    s, u, v = centre_lines(flow)
    u_min, y_u_min = lowest(s, u)
    v_min, x_v_min = lowest(s, v)
    v_max, x_v_max = lowest(s, -v)
    results = {"reynolds": flags.reynolds, "element": flags.element, "size": 1 / cells, "u_min": u_min, "y_u_min": y_u_min, "v_min": v_min, "x_v_min": x_v_min,
               "v_max": -v_max, "x_v_max": x_v_max, "stages": stages, "dofs": flow.dofs, "wall_time": seconds}
    with parser.user_errors(OSError):
        study.write_results(flags.out / "results.json", results)
    at_nodes, title = flow.velocity[:len(mesh.nodes)], f"Reynolds number {flags.reynolds:g}, {flags.element}, {cells} x {cells} cells"
    study.plot_flow(flags.out / "flow.png", mesh, [("speed [m/s]", np.linalg.norm(at_nodes, axis=1), None, at_nodes)], title=title)
    study.print_summary(f"Lid-driven cavity, {title}", results, {"u_min": "m/s", "y_u_min": "m", "v_min": "m/s", "x_v_min": "m", "v_max": "m/s", "x_v_max": "m", "dofs": "", "wall_time": "s"},
                        REFERENCES.get(flags.reynolds, {}), "reference", digits=6)
    return 0


if __name__ == "__main__":
    sys.exit(main())

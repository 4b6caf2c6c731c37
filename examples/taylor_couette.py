"""Flow between two cylinders, the inner one turning: velocity and torque against their closed forms.

    ./run examples/taylor_couette.py --element p2p1 --size 0.03

Radii 0.5 m and 1 m, the inner cylinder turns at 1 rad/s, density 1 kg/m^3, viscosity 0.01 Pa s (Reynolds number 25). Exact, at any Reynolds number as
long as the flow stays in the plane:
    u_theta = A r + B/r,  A = -omega r1^2/(r2^2 - r1^2),  B = omega r1^2 r2^2/(r2^2 - r1^2),  dp/dr = rho u_theta^2/r
    torque that turns the inner cylinder, per depth: 4 pi eta omega r1^2 r2^2/(r2^2 - r1^2)
Elements have straight sides: polygons in place of circles make errors of order size^2, with p2p1 nearly all there are.

Flags
    --element NAME  p1p1 or p2p1 (p2p1)
    --size H        element length [m] (0.03)
    --out DIR       where results.json and flow.png go (out/taylor_couette)

results.json
    torque torque_exact   to turn the inner cylinder, from the forces at its nodes [N m/m]
    torque_outer          to hold the outer one still [N m/m]
    error_u error_p       relative L2 errors [-]
    dofs wall_time        unknowns; seconds in the solver
"""

import sys
import time
from pathlib import Path

import numpy as np

from quicksand import fluid, meshes, study

INNER, OUTER = 0.5, 1.0  # m
TURNING = 1.0  # rad/s
DENSITY, VISCOSITY = 1.0, 0.01  # kg/m^3, Pa s
B = TURNING * INNER**2 * OUTER**2 / (OUTER**2 - INNER**2)
A = -B / OUTER**2


def velocity(x, t):
    r2 = np.sum(x**2, axis=1)
    return (A + B / r2)[:, None] * np.column_stack([-x[:, 1], x[:, 0]])


def pressure(x, t):
    """Its mean over the annulus is 0."""
    def integral(r):  # of rho u_theta^2/r
        return DENSITY * (A**2 * r**2 / 2 + 2 * A * B * np.log(r) - B**2 / (2 * r**2))

    def moment(r):  # of that times r
        return DENSITY * (A**2 * r**4 / 8 + A * B * r**2 * (np.log(r) - 0.5) - B**2 / 2 * np.log(r))

    return integral(np.linalg.norm(x, axis=1)) - 2 * (moment(OUTER) - moment(INNER)) / (OUTER**2 - INNER**2)


def parse_flags():
    parser = study.CommandLine(__doc__)
    parser.add_argument("--element", choices=("p1p1", "p2p1"), default="p2p1")
    parser.add_argument("--size", type=study.number("m", above=0), default=0.03)
    parser.add_argument("--out", type=Path, default=Path("out/taylor_couette"))
    return parser, parser.parse_args()


def main():
    parser, flags = parse_flags()
    with parser.user_errors():
        flags.out.mkdir(parents=True, exist_ok=True)
        mesh = meshes.annulus(INNER, OUTER, flags.size)
        flow = fluid.Fluid(mesh, density=DENSITY, viscosity=VISCOSITY, element=flags.element)
    flow.wall("inner", lambda x, t: TURNING * np.column_stack([-x[:, 1], x[:, 0]]))
    flow.wall("outer")
    flow.mean_pressure(0.0)
    start = time.perf_counter()
    with parser.user_errors(fluid.NotConverged):
        flow.solve_steady()
    seconds = time.perf_counter() - start
    error_u, error_p = flow.error(velocity, pressure)
    results = {"element": flags.element, "size": flags.size, "torque": -flow.torque("inner"), "torque_exact": 4 * np.pi * VISCOSITY * B,
               "torque_outer": -flow.torque("outer"), "error_u": error_u, "error_p": error_p, "dofs": flow.dofs, "wall_time": seconds}
    with parser.user_errors(OSError):
        study.write_results(flags.out / "results.json", results)
    at_nodes = flow.velocity[:len(mesh.nodes)]
    study.plot_flow(flags.out / "flow.png", mesh, [("speed [m/s]", np.linalg.norm(at_nodes, axis=1), None, at_nodes), ("$p$ [Pa]", flow.pressure, None, None)],
                    title=f"{flags.element}, elements of {flags.size:g} m")
    study.print_summary("Between cylinders, the inner one turning", results, {"torque": "N m/m", "torque_outer": "N m/m", "error_u": "-", "error_p": "-", "dofs": "", "wall_time": "s"},
                        {"torque": f"{results['torque_exact']:.6g}", "torque_outer": f"{-results['torque_exact']:.6g}", "error_u": "0", "error_p": "0"}, "exact", digits=6)
    return 0


if __name__ == "__main__":
    sys.exit(main())

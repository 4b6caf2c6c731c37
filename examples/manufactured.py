"""Order of convergence of the fluid on manufactured flows, with a void fraction that varies in space, and in time.

    ./run examples/manufactured.py --case V2 --element p2p1

On [-1, 1]^dim, with s = sin(pi x) sin(pi y) (sin(pi z)) and p = s:
    V1        eps = 1/2 + s/4; u = s grad(s) x grad(g), 2D: g = -z 2/pi, 3D: g = (x + 2 y - z)/pi: no slip, along surfaces of equal eps
    V2        eps = exp(-s - 1), u = exp(s - 1) along each axis: eps u is constant, eps varies sevenfold
    unsteady  eps = 1/2 + s cos(t)/4, eps u = cos(t) (V1's u) + what fills the pores as eps changes; p = s cos(t). Over a time of 1, the
              step as fine as the mesh
The force that makes them solutions is the residual of the momentum balance, taken by sympy. Density 1 kg/m^3.

Flags
    --case NAME       V1, V2 or unsteady (V1)
    --dim N           2 or 3 (2)
    --element NAME    p1p1 or p2p1 (p1p1)
    --sizes H ...     element lengths [m] (2D: 1/8 1/16 1/32; 3D: p1p1 1/6 1/8 1/12, p2p1 1/4 1/6 1/8, which takes a minute)
    --viscosity ETA   [Pa s] (0.1)
    --quick           the two coarsest sizes
    --out DIR         where results.json and orders.png go (out/manufactured)

results.json
    sizes [m] dofs wall_time [s]   of each mesh
    errors_u errors_p              relative L2 errors, at the end [-]
    order_u order_p                of convergence between the two finest meshes
"""

import sys
import time
from pathlib import Path

import numpy as np

from quicksand import fluid, meshes, study

DURATION = 1.0  # s


class Exact:
    """Fields and the force that goes with them, as functions of points (n, dim) and time."""

    def __init__(self, case, dim, viscosity):
        import sympy as sp

        x, t = sp.symbols("x y z")[:dim], sp.Symbol("t")
        s = sp.Mul(*(sp.sin(sp.pi * a) for a in x))
        grad_s = [sp.diff(s, a) for a in x]
        if dim == 2:
            along = [-2 / sp.pi * s * grad_s[1], 2 / sp.pi * s * grad_s[0]]
        else:
            g = [1 / sp.pi, 2 / sp.pi, -1 / sp.pi]
            along = [s * (grad_s[k - 2] * g[k - 1] - grad_s[k - 1] * g[k - 2]) for k in range(3)]
        p, eps = s, sp.Rational(1, 2) + s / 4
        if case == "V1":
            u = along
        elif case == "V2":
            eps, u = sp.exp(-s - 1), [sp.exp(s - 1)] * dim
        else:
            p, eps = s * sp.cos(t), sp.Rational(1, 2) + s * sp.cos(t) / 4
            fills = sp.diff(eps, t) / s / (dim * sp.pi**2)  # div(fills grad s) = -d(eps)/dt
            u = [(sp.cos(t) * a + fills * b) / eps for a, b in zip(along, grad_s)]
        force = []
        for i in range(dim):
            inertia = sp.diff(u[i], t) + sum(u[j] * sp.diff(u[i], x[j]) for j in range(dim))
            viscous = sum(sp.diff(sp.diff(u[i], x[j]) + sp.diff(u[j], x[i]), x[j]) for j in range(dim))
            force.append(eps * (inertia + sp.diff(p, x[i]) - viscosity * viscous))

        def function(expression):
            compiled = sp.lambdify((*x, t), expression, "numpy", cse=True)
            return lambda points, at: np.broadcast_to(compiled(*points.T, at), len(points)).astype(float)

        def vector(expressions):
            parts = [function(e) for e in expressions]
            return lambda points, at: np.column_stack([part(points, at) for part in parts])

        self.eps, self.p, self.u, self.force = function(eps), function(p), vector(u), vector(force)


def solve(case, dim, element, size, viscosity, exact):
    """Errors of u and p, unknowns, and seconds."""
    cells = max(2, round(2 / size))
    mesh = meshes.box([2.0] * dim, counts=[cells] * dim, origin=[-1.0] * dim)
    start = time.perf_counter()
    flow = fluid.Fluid(mesh, density=1.0, viscosity=viscosity, element=element)
    for name in mesh.boundary_names:
        flow.wall(name, exact.u)
    flow.void_fraction = exact.eps
    flow.reaction(force=exact.force)
    if case == "unsteady":
        flow.set_velocity(exact.u(flow.nodes, 0.0))
        flow.set_pressure(exact.p(mesh.nodes, 0.0))
        steps = max(1, round(2 * DURATION / size))
        for _ in range(steps):
            flow.step(DURATION / steps)
    else:
        flow.solve_steady()
    seconds = time.perf_counter() - start
    return *flow.error(exact.u, exact.p), flow.dofs, seconds


def parse_flags():
    parser = study.CommandLine(__doc__)
    parser.add_argument("--case", choices=("V1", "V2", "unsteady"), default="V1")
    parser.add_argument("--dim", type=int, choices=(2, 3), default=2)
    parser.add_argument("--element", choices=("p1p1", "p2p1"), default="p1p1")
    parser.add_argument("--sizes", type=study.number("m", above=0), nargs="+")
    parser.add_argument("--viscosity", type=study.number("Pa s", above=0), default=0.1)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("out/manufactured"))
    flags = parser.parse_args()
    flags.sizes = sorted(flags.sizes or ([1 / 8, 1 / 16, 1 / 32] if flags.dim == 2 else [1 / 6, 1 / 8, 1 / 12] if flags.element == "p1p1" else [1 / 4, 1 / 6, 1 / 8]), reverse=True)
    if flags.quick:
        flags.sizes = flags.sizes[:2]
    if len(flags.sizes) < 2:
        parser.error("argument --sizes: an order needs two sizes")
    return parser, flags


def main():
    parser, flags = parse_flags()
    with parser.user_errors():
        flags.out.mkdir(parents=True, exist_ok=True)
    exact = Exact(flags.case, flags.dim, flags.viscosity)
    rows = []
    for size in flags.sizes:
        rows.append(solve(flags.case, flags.dim, flags.element, size, flags.viscosity, exact))
        print(f"size {size:.4g} m: error of u {rows[-1][0]:.3e}, of p {rows[-1][1]:.3e}, {rows[-1][2]} unknowns, {rows[-1][3]:.2f} s", flush=True)
    errors_u, errors_p, dofs, seconds = (list(column) for column in zip(*rows))
    finer = np.log(flags.sizes[-2] / flags.sizes[-1])
    results = {"case": flags.case, "dim": flags.dim, "element": flags.element, "sizes": flags.sizes, "errors_u": errors_u, "errors_p": errors_p,
               "order_u": float(np.log(errors_u[-2] / errors_u[-1]) / finer), "order_p": float(np.log(errors_p[-2] / errors_p[-1]) / finer),
               "dofs": dofs, "wall_time": seconds}
    with parser.user_errors(OSError):
        study.write_results(flags.out / "results.json", results)
    study.plot_lines(flags.out / "orders.png", "element length [m]", "relative L2 error", [
        (f"{flags.case}, {flags.dim}D, {flags.element}", [("velocity", "#1f5fa8", flags.sizes, errors_u), ("pressure", "#c2452d", flags.sizes, errors_p)])])
    study.print_summary(f"Manufactured flow {flags.case}, {flags.dim}D, {flags.element}", results, {"order_u": "-", "order_p": "-"})
    return 0


if __name__ == "__main__":
    sys.exit(main())

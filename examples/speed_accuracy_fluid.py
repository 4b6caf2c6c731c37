"""Fluid: error against wall time, for both elements, meshes, time steps and linear solvers, beside FEniCSx where it is installed.

    OMP_NUM_THREADS=1 ./run examples/speed_accuracy_fluid.py --out out/speed_accuracy_fluid

Flags
    --cases NAME ...   V1, V2, unsteady (manufactured.py), cylinder (steady, cylinder_in_channel.py) (all)
    --repeat N         runs of each point, in turn; times are medians (3)
    --quick            coarse meshes, one run each, without FEniCSx
    --out DIR          results.json, tables.md and fluid.png (out/speed_accuracy_fluid)

Error: relative L2 of velocity and pressure; of the cylinder |c_D / 5.57953523 - 1| and |dp / 0.11752017 - 1|. Time: of assembly and linear solution, from the
fluid at rest; meshes, unknowns and the forms of FEniCSx, and their compilation, are apart. FEniCSx: Debian's python3-dolfinx, Taylor-Hood, MUMPS, the
same equations, iterations and tolerances (examples/peers/dolfinx_flow.py), one thread like ours.

results.json: lists over points
    case code solver cells steps       of each; cells to a side, of the cylinder element length at it [m]; steps 0: steady
    error_u error_p wall_time dofs     [-] [-] [s] [-]
ratio_CASE_E: time of our better element over that of FEniCSx at an error of E in velocity (cylinder: drag), between points on both curves
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import manufactured
from quicksand import fluid, meshes, study

VISCOSITY = {"V1": 0.1, "V2": 0.1, "unsteady": 0.1, "cylinder": 1e-3}  # [Pa s]
SIZES = {"V1": (4, 8, 16, 32, 64, 128), "V2": (4, 8, 16, 32, 64, 128), "unsteady": (4, 8, 16, 32, 64), "cylinder": (0.02, 0.01, 0.005, 0.0025)}
COLOURS = {"p1p1": "#1f5fa8", "p1p1, ilu": "#7fb0e0", "p2p1": "#c2452d", "dolfinx": "#8a5a00"}
C_D, DP = 5.57953523, 0.11752017  # M. Schaefer, S. Turek (1996), and later refinements


def points(case, quick):
    """(code, solver, cells, steps) of each run."""
    for cells in SIZES[case][:2] if quick else SIZES[case]:
        for steps in (cells, 2 * cells) if case == "unsteady" else (0,):
            yield "p1p1", "direct", cells, steps
            if case in ("V1", "unsteady"):
                yield "p1p1", "ilu", cells, steps
            if not (case in ("V1", "V2") and cells > 64):
                yield "p2p1", "direct", cells, steps
                if not quick:
                    yield "dolfinx", "direct", cells, steps


def make_mesh(case, cells):
    if case == "cylinder":
        return meshes.cylinder_in_channel(cells)
    return meshes.box([2.0, 2.0], counts=[cells, cells], origin=[-1.0, -1.0])


def run_ours(case, element, solver, mesh, steps, exact):
    flow = fluid.Fluid(mesh, density=1.0, viscosity=VISCOSITY[case], element=element)
    flow.solver = solver
    if case == "cylinder":
        flow.inflow("inflow", lambda x, t: np.column_stack([1.2 * x[:, 1] * (0.41 - x[:, 1]) / 0.41**2, 0 * x[:, 0]]))
        flow.wall("walls")
        flow.wall("cylinder")
        flow.outflow("outflow")
    else:
        for name in mesh.boundary_names:
            flow.wall(name, exact.u)
        flow.void_fraction = exact.eps
        flow.reaction(force=exact.force)
    if steps:
        flow.set_velocity(exact.u(flow.nodes, 0.0))
        flow.set_pressure(exact.p(mesh.nodes, 0.0))
    start = time.perf_counter()
    if steps:
        for _ in range(steps):
            flow.step(1.0 / steps)
    else:
        flow.solve_steady()
    seconds = time.perf_counter() - start
    if case == "cylinder":
        p = flow.probe([[0.15, 0.2], [0.25, 0.2]])["pressure"]
        return abs(500 * flow.force("cylinder")[0] / C_D - 1), abs((p[0] - p[1]) / DP - 1), seconds, flow.dofs
    return *flow.error(exact.u, exact.p), seconds, flow.dofs


def run_dolfinx(case, cells, mesh, steps):
    """As run_ours(); None where dolfinx is not installed."""
    with tempfile.TemporaryDirectory() as folder:
        spec = {"case": case, "cells": cells, "steps": steps, "viscosity": VISCOSITY[case], "mesh": f"{folder}/mesh.npz"}
        if case == "cylinder":
            np.savez(spec["mesh"], nodes=mesh.nodes, elements=mesh.elements)
        script = Path(__file__).parent / "peers" / "dolfinx_flow.py"
        # Nothing of this process's MPI, if it runs, and one thread.
        done = subprocess.run([sys.executable, script, json.dumps(spec)], capture_output=True, text=True,
                              env={"PATH": "/usr/bin:/bin", "HOME": str(Path.home()), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"})
    if done.returncode != 0:
        if "No module named 'dolfinx'" in done.stderr:
            return None
        raise RuntimeError(f"dolfinx failed: {done.stderr[-1000:]}")
    found = json.loads(done.stdout.splitlines()[-1])
    if case == "cylinder":
        return abs(found["c_d"] / C_D - 1), abs(found["dp"] / DP - 1), found["wall_time"], found["dofs"]
    return found["error_u"], found["error_p"], found["wall_time"], found["dofs"]


def measure(case, flags):
    exact = None if case == "cylinder" else manufactured.Exact(case, 2, VISCOSITY[case])
    rows, meshes_of = {}, {}
    for _ in range(flags.repeat):  # in turn: what else runs on the machine slows all
        for point in points(case, flags.quick):
            code, solver, cells, steps = point
            mesh = meshes_of.setdefault(cells, make_mesh(case, cells))
            found = run_dolfinx(case, cells, mesh, steps) if code == "dolfinx" else run_ours(case, code, solver, mesh, steps, exact)
            if found:
                rows.setdefault(point, []).append(found)
    for (code, solver, cells, steps), runs in rows.items():
        error_u, error_p, _, dofs = runs[0]
        yield {"case": case, "code": code, "solver": solver, "cells": cells, "steps": steps, "error_u": float(error_u), "error_p": float(error_p),
               "wall_time": float(np.median([run[2] for run in runs])), "dofs": dofs}


def front(rows, code):
    """Errors and the least times to them, falling errors."""
    best = []
    for row in sorted((r for r in rows if r["code"] == code), key=lambda r: r["wall_time"]):
        if not best or row["error_u"] < best[-1][0]:
            best.append((row["error_u"], row["wall_time"]))
    return np.array(best)


def time_at(rows, code, error):
    """Seconds to an error, between points of the front; nan beyond it."""
    e, t = np.log(front(rows, code)[::-1]).T
    return float(np.exp(np.interp(np.log(error), e, t))) if e[0] <= np.log(error) <= e[-1] else np.nan


def main():
    parser = study.CommandLine(__doc__)
    parser.add_argument("--cases", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--repeat", type=study.whole(at_least=1))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("out/speed_accuracy_fluid"))
    flags = parser.parse_args()
    flags.repeat = flags.repeat or (1 if flags.quick else 3)
    with parser.user_errors():
        flags.out.mkdir(parents=True, exist_ok=True)
    rows, results = [], {}
    for case in flags.cases:
        rows += measure(case, flags)
        mine = [row for row in rows if row["case"] == case]
        if any(row["code"] == "dolfinx" for row in mine):
            for error in (1e-2, 1e-3, 1e-4):
                ratio = np.nanmin([time_at(mine, code, error) for code in ("p1p1", "p2p1")] + [np.inf]) / time_at(mine, "dolfinx", error)
                if np.isfinite(ratio):
                    results[f"ratio_{case}_{error:g}"] = float(ratio)
                    print(f"{case}: {ratio:.2f} of FEniCSx's time at an error of {error:g}", flush=True)
    results |= {name: [row[name] for row in rows] for name in rows[0]}
    lines = ["| case | code | solver | cells or size | steps | error of u (c_D) | of p (dp) | time [s] | unknowns |", "|---" * 9 + "|"]
    lines += [f"| {r['case']} | {r['code']} | {r['solver']} | {r['cells']:g} | {r['steps']} | {r['error_u']:.2e} | {r['error_p']:.2e} | {r['wall_time']:.3g} | {r['dofs']} |" for r in rows]
    with parser.user_errors(OSError):
        study.write_results(flags.out / "results.json", results)
        (flags.out / "tables.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
    panels = []
    for case in flags.cases:
        curves = []
        for label, colour in COLOURS.items():
            code, _, solver = label.partition(", ")
            chosen = [r for r in rows if r["case"] == case and r["code"] == code and (r["solver"] == (solver or "direct"))]
            if case == "unsteady":  # the points on the front over steps
                chosen = sorted((r for r in chosen if not any(o["error_u"] <= r["error_u"] and o["wall_time"] < r["wall_time"] for o in chosen)), key=lambda r: r["wall_time"])
            if chosen:
                curves.append((label, colour, [r["wall_time"] for r in chosen], [r["error_u"] for r in chosen]))
        panels.append((f"{case}: error of {'c_D' if case == 'cylinder' else 'velocity'} [-]", curves))
    study.plot_lines(flags.out / "fluid.png", "wall time [s]", "relative error", panels)
    return 0


if __name__ == "__main__":
    sys.exit(main())

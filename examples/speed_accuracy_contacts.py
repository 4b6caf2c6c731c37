"""Contact solvers: wall time against error, on third-party problems, columns of grains, states of a flow, and whole runs.

    ./run examples/speed_accuracy_contacts.py --out out/speed_accuracy_contacts

Flags
    --parts NAME ...    problems, columns, estimate, states, runs, spheres (all)
    --repeat N          times are medians of so many solves (11)
    --out DIR           results.json, tables.md and figures (out/speed_accuracy_contacts)
    --quick             three solves, columns of up to 40 layers, without Siconos

problems: the eight files of tests/data/frictional_contact from r = 0, to 1e-4 and 1e-8, by nlgs, accelerated, newton and auto, one thread, the solver's call
    only; by Siconos' NSGS too where Debian's python3-siconos is installed. Figure profile.png: the share of problems that a solver
    solves within a factor of the time of the fastest (Dolan and More, Math. Program. 91 (2002)).
columns: single columns of discs from zero impulses until every contact force is within 1e-4 of the weight above it.
estimate: the global error estimate against the true error, over sweeps of NLGS on such columns, single and four wide (hexagonal).
states: one sub-step of plane Couette flow (dry_couette.py: collisional, size ratio 1 at 20 /s, and quasi-static, 1.5 at 1 /s) by every solver of
    scenes at tolerances from 0.1 to 1e-8, warm; errors in the energy norm against the solver's own solution at 1e-9.
runs: whole runs over tolerance, sub-steps and time step, beside LAMMPS where it is installed (whole_runs.py); about half an hour.
spheres: 10 000 spheres sheared between rough walls at I = 0.01, and the time that LAMMPS takes for them. Runs that --out/runs and --out/spheres
    hold are not made again.

results.json, flat; lists run over the cases of a part:
    problems problem_solvers problem_tolerances problem_errors problem_times   time [s], null: not solved in 20 000 iterations
    column_solvers column_layers column_times [s] column_iterations   null: not within 1e-4 at any tolerance down to 1e-10
    column_exponent_SOLVER              slope of log time over log layers, from 40 layers on [-]
    state_names state_solvers state_tolerances state_residuals state_errors state_times [s] state_sweeps state_updates state_converged
    state_contacts_NAME  state_gain_NAME   time of nlgs over that of auto at a residual of 1e-4, interpolated [-]
    run_names run_mu run_mu_err run_phi run_phi_err run_overlap run_overlap_max [d] run_seconds (per simulated second) run_unconverged run_sub_steps
    sphere_names sphere_mu sphere_mu_err sphere_phi sphere_phi_err sphere_overlap_max [d] sphere_unconverged sphere_seconds (per unit strain)
    estimate_layers estimate_width estimate_sweeps estimate_residuals estimate_true estimate_estimates estimate_ratio_min estimate_ratio_max
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import dry_couette
import whole_runs
from quicksand import grains, study

DATA = Path(__file__).parents[1] / "tests" / "data" / "frictional_contact"
GRAVITY, RADIUS, DENSITY, DT = 9.81, 1e-3, 2500.0, 1e-3
MOST = 20000  # iterations
COLOURS = {"nlgs": "#1f5fa8", "newton": "#c2452d", "auto": "#222222", "active_set": "#2e7d4f", "accelerated": "#7a4fa3", "siconos": "#8a5a00"}
SCENE_SOLVERS = ("nlgs", "active_set", "accelerated", "newton", "auto")
PARTS = ("problems", "columns", "estimate", "states", "runs", "spheres")
STATES = {"collisional": (1.0, 20.0), "quasi-static": (1.5, 1.0)}  # size ratio, rate [1/s]


def parse_flags():
    parser = study.CommandLine(__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--repeat", type=study.whole(at_least=1))
    parser.add_argument("--out", type=Path, default=Path("out/speed_accuracy_contacts"))
    parser.add_argument("--quick", action="store_true")
    flags = parser.parse_args()
    flags.repeat = flags.repeat or (3 if flags.quick else 11)
    with parser.user_errors():
        flags.out.mkdir(parents=True, exist_ok=True)
    return flags


def siconos_nsgs(problem, folder):
    """A function tolerance -> (r, seconds) by Siconos' NSGS, or None where Siconos is not installed."""
    try:
        from siconos import numerics
    except ImportError:
        return None
    numerics.numerics_set_verbose(0)
    dim, n, blocks = problem.dim, problem.contacts, problem.W.tobsr((problem.dim,) * 2)
    blocks.sort_indices()
    ends = " ".join(str(dim * (c + 1)) for c in range(n))
    words = [f"{dim}\n{n}\n1\n{dim * n}\n{dim * n}\n{blocks.indices.size}\n{n}\n{n}\n{ends}\n{ends}\n{n + 1}\n{blocks.indices.size}",
             " ".join(map(str, blocks.indptr)), " ".join(map(str, blocks.indices))]
    for k, block in enumerate(blocks.data):
        words.append(f"{k}\n" + "\n".join(f"{x:.17e}" for x in block.ravel(order="F")))
    words += [" ".join(f"{x:.17e}" for x in values) for values in (problem.q, problem.friction)]
    path = folder / "problem.dat"
    path.write_text("\n".join(words) + "\n")
    theirs = numerics.frictionContact_new_from_filename(str(path))
    kind, driver = ((numerics.SICONOS_FRICTION_2D_NSGS, numerics.fc2d_driver) if dim == 2
                    else (numerics.SICONOS_FRICTION_3D_NSGS, numerics.fc3d_driver))

    def solve(tolerance):
        options = numerics.SolverOptions(kind)
        options.dparam[numerics.SICONOS_DPARAM_TOL], options.iparam[numerics.SICONOS_IPARAM_MAX_ITER] = tolerance, MOST
        # The error of the whole problem decides; in 2D only "light with a full one at the end" does that.
        options.iparam[numerics.SICONOS_FRICTION_3D_IPARAM_ERROR_EVALUATION] = (
            numerics.SICONOS_FRICTION_3D_NSGS_ERROR_EVALUATION_LIGHT_WITH_FULL_FINAL if dim == 2
            else numerics.SICONOS_FRICTION_3D_NSGS_ERROR_EVALUATION_FULL)
        r, u = np.zeros(dim * n), np.zeros(dim * n)
        start = time.perf_counter()
        info = driver(theirs, r, u, options)
        return (r if info == 0 else None), time.perf_counter() - start

    return solve


def measure_problems(flags):
    rows = []
    for path in sorted(DATA.glob("*.hdf5")):
        problem = grains.read_fclib(path)

        def ours(name):
            def solve(tolerance):
                found = problem.solve(name, tolerance, MOST)
                return (found.r if found.converged else None), found.wall_time
            return solve

        solvers = {name: ours(name) for name in ("nlgs", "accelerated", "newton", "auto")}
        with tempfile.TemporaryDirectory() as folder:
            if not flags.quick and (theirs := siconos_nsgs(problem, Path(folder))):
                solvers["siconos"] = theirs
        for tolerance in (1e-4, 1e-8):
            times, r = {name: [] for name in solvers}, {}
            for _ in range(flags.repeat):  # in turn: what else runs on the machine slows all
                for name, solve in solvers.items():
                    if r.get(name, True) is not None:
                        r[name], seconds = solve(tolerance)
                        times[name].append(seconds)
            for name in solvers:
                solved = r[name] is not None
                rows.append((path.stem, name, tolerance, problem.error(r[name]) if solved else None,
                             float(np.median(times[name])) if solved else None))
    return dict(zip(("problems", "problem_solvers", "problem_tolerances", "problem_errors", "problem_times"), map(list, zip(*rows))))


def column(layers, width=1, **settings):
    sim = grains.Simulation(dim=2, period=None if width == 1 else (2 * RADIUS * width, None), gravity=(0, -GRAVITY), threads=1,
                            accept_unconverged=True, **settings)
    sim.set_friction("grain", "grain", 0.3)
    sim.set_friction("grain", "wall", 0.3)
    row, place = np.divmod(np.arange(layers * width), width)
    height = 2 if width == 1 else np.sqrt(3)
    x = (place + 0.25 + 0.5 * (row % 2) - width / 2) * 2 * RADIUS if width > 1 else np.zeros(layers)
    sim.add(np.column_stack([x, RADIUS * (1 + height * row)]), RADIUS, density=DENSITY)
    sim.add_plane((0, 0), (0, 1))
    return sim


def time_of_column(layers, solver, repeat):
    """Seconds and iterations until every force is within 1e-4 of the weight above; None where no tolerance gets there."""
    for tolerance in 10.0 ** -np.arange(3, 11):
        seconds = []
        for _ in range(repeat):
            sim = column(layers, solver=solver, tolerance=tolerance, max_sweeps=10**6)
            start = time.perf_counter()
            report = sim.step(DT)
            seconds.append(time.perf_counter() - start)
            contacts = sim.contacts()
            below = np.rint(contacts["point"][:, 1] / (2 * RADIUS))
            weight = (layers - below) * GRAVITY * sim.mass[0]
            if len(weight) < layers or np.abs(contacts["force_normal"] / weight - 1).max() > 1e-4:
                break
        else:
            return float(np.median(seconds)), report.sweeps
    return None, None


def measure_columns(flags):
    layers = [10, 20, 40] if flags.quick else [10, 20, 40, 80, 160, 320]
    results = {"column_solvers": [], "column_layers": [], "column_times": [], "column_iterations": []}
    for solver in SCENE_SOLVERS:
        times = []
        for n in layers:
            if solver == "nlgs" and n > 160:
                continue  # a quarter of a million sweeps
            seconds, iterations = time_of_column(n, solver, min(flags.repeat, 5))
            times.append(seconds)
            for name, value in zip(results, (solver, n, seconds, iterations)):
                results[name].append(value)
        known = [(n, t) for n, t in zip(layers, times) if t is not None and n >= (10 if flags.quick else 40)]
        results[f"column_exponent_{solver}"] = float(np.polyfit(*np.log(np.array(known).T), 1)[0]) if len(known) > 1 else None
    return results


def measure_estimate(flags):
    rows = []
    for n in (20, 40) if flags.quick else (20, 80, 320):
        for width in (1, 4):
            for sweeps in (1, 10, 100, 1000, 10000):
                sim = column(n, width, solver="nlgs", tolerance=1e-9, max_sweeps=sweeps)
                report = sim.step(DT)
                true = np.sqrt((sim.velocity**2).sum() / sim.count) / (GRAVITY * DT)  # at rest is right; free, all fall by g dt
                rows.append((n, width, sweeps, report.residual, float(true), sim.global_error()))
    names = ("layers", "width", "sweeps", "residuals", "true", "estimates")
    results = {f"estimate_{name}": list(values) for name, values in zip(names, zip(*rows))}
    ratio = [row[5] / row[4] for row in rows if row[4] > 1e-6]
    return results | {"estimate_ratio_min": min(ratio), "estimate_ratio_max": max(ratio)}


def developed(size_ratio, rate, quick):
    """State of a flow after 2 s, and the sub-step that it takes [s]."""
    size = {"height": 0.03, "width": 0.06} if quick else {"height": 0.1, "width": 0.2}
    scene = dry_couette.scene(size_ratio=size_ratio, rate=rate, threads=1, **size)
    for _ in range(300 if quick else 2000):
        report = scene.sim.step(DT)
    return scene.sim, scene.sim.state(), DT / report.sub_steps


def one_step(sim, state, h, solver, tolerance, repeat):
    """Median solver time [s] of one sub-step from a state, its report, and the grains' velocities weighed: their squares sum up to twice the energy."""
    seconds = []
    while len(seconds) < repeat and sum(seconds) < 2.0:
        sim.restore(state)
        sim.solver, sim.tolerance, sim.max_sweeps = solver, tolerance, 50000
        report = sim.step(h)
        seconds.append(report.solve_time)
    return float(np.median(seconds)), report, weighed_velocity(sim)


def weighed_velocity(sim):
    return np.sqrt(sim.mass[:, None]) * np.column_stack([sim.velocity, np.sqrt(0.5) * sim.radius * sim.spin])


def measure_states(flags):
    rows, results = [], {}
    for name, (size_ratio, rate) in STATES.items():
        sim, state, h = developed(size_ratio, rate, flags.quick)
        sim.restore(state)
        before = weighed_velocity(sim)
        for solver in SCENE_SOLVERS:
            *_, exact = one_step(sim, state, h, solver, 1e-9, 1)
            size = np.linalg.norm(exact - before)  # there is no gravity: contacts make all of it
            for tolerance in 10.0 ** np.arange(-1, -4 if flags.quick else -8.5, -1 if flags.quick else -0.5):
                seconds, report, found = one_step(sim, state, h, solver, tolerance, flags.repeat)
                error = np.linalg.norm(found - exact) / size
                rows.append((name, solver, tolerance, report.residual, float(error), seconds, report.sweeps, report.updates, report.unconverged == 0))
        results[f"state_contacts_{name}"] = grains.contact_problem(sim)[0].contacts
    results |= dict(zip((f"state_{x}" for x in ("names", "solvers", "tolerances", "residuals", "errors", "times", "sweeps", "updates", "converged")),
                        map(list, zip(*rows))))
    for name in STATES:
        nlgs, auto = (time_at(results, name, solver, 1e-2 if flags.quick else 1e-4) for solver in ("nlgs", "auto"))
        results[f"state_gain_{name}"] = nlgs / auto
    return results


def time_at(results, name, solver, residual):
    """Seconds to a residual, between those measured."""
    rows = [(r, t) for n, s, r, t in zip(*(results[f"state_{x}"] for x in ("names", "solvers", "residuals", "times"))) if (n, s) == (name, solver)]
    r, t = np.log(np.array(sorted(rows)).T)
    return float(np.exp(np.interp(np.log(residual), r, t)))


def profile(results, tolerance):
    """Per solver: time of each problem over that of the fastest, inf where not solved."""
    rows = list(zip(results["problems"], results["problem_solvers"], results["problem_tolerances"], results["problem_times"]))
    solvers, problems = dict.fromkeys(row[1] for row in rows), dict.fromkeys(row[0] for row in rows)
    times = {(p, s): t or np.inf for p, s, at, t in rows if at == tolerance}
    fastest = {p: min(times[p, s] for s in solvers) for p in problems}
    return {s: np.sort([times[p, s] / fastest[p] for p in problems]) for s in solvers}


def tables(results):
    lines = []
    if "problems" in results:
        solvers = list(dict.fromkeys(results["problem_solvers"]))
        lines += ["Median time [ms] from r = 0; -: not solved in 20 000 iterations", "",
                  "| problem | to | " + " | ".join(solvers) + " |", "|---" * (len(solvers) + 2) + "|"]
        cases = {}
        for p, s, tolerance, t in zip(*(results[k] for k in ("problems", "problem_solvers", "problem_tolerances", "problem_times"))):
            cases.setdefault((p, tolerance), {})[s] = "-" if t is None else f"{1e3 * t:.3g}"
        lines += [f"| {p} | {tolerance:g} | " + " | ".join(case[s] for s in solvers) + " |" for (p, tolerance), case in cases.items()]
    if "column_layers" in results:
        lines += ["", "Single columns, every force within 1e-4 of the weight above", "", "| solver | layers | time [ms] | iterations |", "|---|---|---|---|"]
        lines += [f"| {s} | {n} | {'-' if t is None else f'{1e3 * t:.3g}'} | {i or '-'} |" for s, n, t, i in
                  zip(*(results[f"column_{k}"] for k in ("solvers", "layers", "times", "iterations")))]
    if "estimate_true" in results:
        lines += ["", "NLGS stopped early", "", "| layers | width | sweeps | residual | true error | estimate |", "|---" * 6 + "|"]
        lines += [f"| {n} | {w} | {k} | {r:.1e} | {true:.3e} | {e:.3e} |" for n, w, k, r, true, e in
                  zip(*(results[f"estimate_{k}"] for k in ("layers", "width", "sweeps", "residuals", "true", "estimates")))]
    if "state_names" in results:
        lines += ["", "One sub-step of a flow, warm", "", "| state | solver | tolerance | residual | error | time [ms] | sweeps | ns per contact update |", "|---" * 8 + "|"]
        lines += [f"| {n} | {s} | {tolerance:.1e} | {r:.1e} | {e:.1e} | {1e3 * t:.3g} | {sweeps} | {1e9 * t / updates if updates else 0:.2f} |" for n, s, tolerance, r, e, t, sweeps, updates in
                  zip(*(results[f"state_{k}"] for k in ("names", "solvers", "tolerances", "residuals", "errors", "times", "sweeps", "updates")))]
    if "run_names" in results:
        lines += whole_runs.table(results)
    if "sphere_names" in results:
        lines += whole_runs.sphere_table(results)
    return "\n".join(lines) + "\n"


def plot(out, results):
    if "problems" in results:
        study.plot_lines(out / "profile.png", "time over that of the fastest solver", "share of problems solved", [
            (f"to {tolerance:g}", [(s, COLOURS[s], np.append(x[np.isfinite(x)], 1e4), np.append(np.arange(1, np.isfinite(x).sum() + 1),
                                    np.isfinite(x).sum()) / len(x)) for s, x in profile(results, tolerance).items()]) for tolerance in (1e-4, 1e-8)],
            scales=("log", "linear"), steps=True)
    if "column_layers" in results:
        s, n, t = (np.array(results[f"column_{k}"], dtype) for k, dtype in (("solvers", str), ("layers", float), ("times", float)))
        study.plot_lines(out / "columns.png", "layers", "time to 1e-4 in every force [s]",
                         [("", [(name, COLOURS[name], n[s == name], t[s == name]) for name in dict.fromkeys(s)])])
    if "estimate_true" in results:
        n, w, true, residual, estimate = (np.array(results[f"estimate_{k}"], float) for k in ("layers", "width", "true", "residuals", "estimates"))
        study.plot_lines(out / "estimate.png", "true error [-]", "what is reported [-]", [
            (f"{layers:g} layers", [(label, colour, true[chosen], value[chosen]) for label, colour, value in
                                    (("residual", COLOURS["nlgs"], residual), ("global error", COLOURS["newton"], estimate))])
            for layers in dict.fromkeys(n) for chosen in [(n == layers) & (true > 1e-9)]], points=True, diagonal=True)
    if "state_names" in results:
        names, solvers = (np.array(results[f"state_{k}"]) for k in ("names", "solvers"))
        times = np.array(results["state_times"], float)
        for kind in ("residual", "error"):
            value = np.array(results[f"state_{kind}s"], float)
            study.plot_lines(out / f"states_{kind}.png", "time of the solver [s]", f"{kind} [-]", [
                (name, [(s, COLOURS[s], times[chosen], value[chosen]) for s in SCENE_SOLVERS for chosen in [(names == name) & (solvers == s)]]) for name in STATES])
    if "run_names" in results:
        whole_runs.plot(out / "runs.png", results)


def main():
    flags = parse_flags()
    results = {}
    for part in flags.parts:
        results |= {"problems": measure_problems, "columns": measure_columns, "estimate": measure_estimate, "states": measure_states,
                    "runs": whole_runs.measure, "spheres": whole_runs.measure_spheres}[part](flags)
    study.write_results(flags.out / "results.json", results)
    text = tables(results)
    (flags.out / "tables.md").write_text(text)
    print(text)
    for name in results:
        if name.startswith("column_exponent") and results[name] is not None:
            print(f"{name.removeprefix('column_exponent_')}: time grows as layers^{results[name]:.2f}")
    if "estimate_ratio_min" in results:
        print(f"estimate / true error: {results['estimate_ratio_min']:.3f} to {results['estimate_ratio_max']:.3f}")
    plot(flags.out, results)
    return 0


if __name__ == "__main__":
    sys.exit(main())

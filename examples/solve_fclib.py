"""Solve a frictional contact problem of the FCLIB collection, or one that a run has left.

    ./run examples/solve_fclib.py tests/data/frictional_contact/BoxesStack1-i100000-32.hdf5 --tolerance 1e-8 --solver auto --out out/solve_fclib

The file holds u = W r + q and friction (`fclib_local`, HDF5); r and u obey Signorini's and Coulomb's laws.

Flags
    --tolerance E       on the error below [-] (1e-8)
    --solver NAME       auto, nlgs (nonlinear Gauss-Seidel), accelerated (the same with Nesterov's extrapolation) or newton (semismooth,
                        with proximal points) (auto)
    --max-iterations N  sweeps and Newton iterations (100000)
    --out DIR           where results.json, solution.hdf5 and error.png go (out/solve_fclib)
    --no-plots          no figure

results.json; nothing here has units:
    dim contacts
    solver          that made the last iterations: nlgs, accelerated or newton
    iterations      sweeps and Newton iterations
    error           |e| / max(|q|, |u|, |r|), e = r - P_K(r - (u + mu |u_t| n)), of the r in solution.hdf5
    converged       whether it is within the tolerance; exit status 1 if not
    wall_time       of the solver alone, from r = 0 [s]
    error_history   the error whenever it was measured
solution.hdf5 is the problem with FCLIB's group `solution`: r and u, components as in the file.
"""

import sys
from pathlib import Path

from quicksand import grains, study


def parse_flags():
    parser = study.CommandLine(__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--tolerance", type=study.number("", above=0), default=1e-8)
    parser.add_argument("--solver", choices=("auto", "nlgs", "accelerated", "newton"), default="auto")
    parser.add_argument("--max-iterations", type=study.whole(at_least=1), default=100000)
    parser.add_argument("--out", type=Path, default=Path("out/solve_fclib"))
    parser.add_argument("--no-plots", action="store_true")
    return parser, parser.parse_args()


def main():
    parser, flags = parse_flags()
    with parser.user_errors():
        problem = grains.read_fclib(flags.file)
        flags.out.mkdir(parents=True, exist_ok=True)
        found = problem.solve(flags.solver, flags.tolerance, flags.max_iterations)
        grains.write_fclib(flags.out / "solution.hdf5", problem, found)
        r, _ = grains.read_solution(flags.out / "solution.hdf5")
    results = {"dim": problem.dim, "contacts": problem.contacts, "solver": found.solver, "iterations": found.iterations,
               "error": problem.error(r), "converged": found.converged, "wall_time": found.wall_time, "error_history": found.error_history}
    with parser.user_errors(OSError):
        study.write_results(flags.out / "results.json", results)
    study.print_summary(f"{flags.file.name}: {'solved' if found.converged else 'not solved'} by {found.solver}", results,
                        {"dim": "", "contacts": "", "iterations": "", "error": "-", "wall_time": "s"})
    if not flags.no_plots:
        study.plot_errors(flags.out / "error.png", found.iteration_history, found.error_history, flags.tolerance)
    if not found.converged:
        print(f"{parser.prog}: error {results['error']:.2g} is above the tolerance {flags.tolerance:g} after {found.iterations} iterations; "
              "raise --max-iterations, or try --solver newton", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""examples/speed_accuracy_contacts.py: its parts, keys and figures. Its times are not looked at."""

import json
import os
import subprocess
import sys
from pathlib import Path

import quicksand

EXAMPLE = Path(__file__).parents[2] / "examples" / "speed_accuracy_contacts.py"
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(quicksand.__file__).parents[1]), "OMP_WAIT_POLICY": "passive"}


def test_newton_needs_as_many_iterations_for_40_layers_as_for_10_and_the_estimate_is_that_of_the_velocities(tmp_path):
    done = subprocess.run([sys.executable, EXAMPLE, "--quick", "--repeat", "1", "--out", tmp_path], env=ENVIRONMENT, capture_output=True,
                          text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    results = json.loads((tmp_path / "results.json").read_text())
    iterations = dict(zip(zip(results["column_solvers"], results["column_layers"]), results["column_iterations"]))
    assert iterations["newton", 40] <= iterations["newton", 10] + 2 < 10
    assert iterations["nlgs", 40] > 8 * iterations["nlgs", 10]  # as layers^2
    assert 0.9 < results["estimate_ratio_min"] <= results["estimate_ratio_max"] < 1.1
    assert 2.5 * iterations["accelerated", 20] > iterations["accelerated", 40]  # as layers
    solved = [e for s, e in zip(results["problem_solvers"], results["problem_errors"]) if s in ("auto", "newton")]
    assert len(solved) == 32 and all(e is not None and e <= 1e-4 for e in solved)
    failed = [s for s, t in zip(results["problem_solvers"], results["problem_times"]) if t is None]
    assert failed.count("nlgs") == 3 and failed.count("accelerated") == 1  # those that more contacts than freedoms make singular
    states = zip(*(results[f"state_{x}"] for x in ("names", "solvers", "tolerances", "residuals", "errors", "converged")))
    last = {}
    for name, solver, tolerance, residual, error, converged in states:
        assert converged and residual <= tolerance
        assert error < last.get((name, solver), 2.0)  # of what contacts change: more than all of it where sweeps have hardly begun
        last[name, solver] = error
    assert len(last) == 10 and max(last.values()) < 0.4  # of the quasi-static one, at a residual of 1e-3
    runs = dict(zip(results["run_names"], zip(results["run_mu"], results["run_overlap"])))
    assert runs["reference"][1] < 0.2 * runs["default"][1] and abs(runs["default"][0] - runs["reference"][0]) < 0.15
    assert 0.2 < results["sphere_mu"][0] < 0.6 and 0.55 < results["sphere_phi"][0] < 0.64
    for name in ("profile.png", "columns.png", "estimate.png", "states_residual.png", "states_error.png", "runs.png", "tables.md"):
        assert (tmp_path / name).stat().st_size > 500

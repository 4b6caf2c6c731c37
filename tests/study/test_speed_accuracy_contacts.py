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
    solved = [(s, e) for s, e in zip(results["problem_solvers"], results["problem_errors"]) if s != "nlgs"]
    assert len(solved) == 32 and all(e is not None and e <= 1e-4 for _, e in solved)
    assert results["problem_times"].count(None) == 3  # NLGS, the three that it does not solve
    for name in ("profile.png", "columns.png", "estimate.png", "tables.md"):
        assert (tmp_path / name).stat().st_size > 500

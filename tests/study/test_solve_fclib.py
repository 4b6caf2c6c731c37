"""examples/solve_fclib.py: its run line, its keys, its exit status."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import quicksand
from quicksand import grains

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "solve_fclib.py"
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(quicksand.__file__).parents[1]), "OMP_WAIT_POLICY": "passive"}
BOXES = "tests/data/frictional_contact/BoxesStack1-i100000-32.hdf5"


def go(*args):
    return subprocess.run([sys.executable, EXAMPLE, *map(str, args)], env=ENVIRONMENT, capture_output=True, text=True, timeout=60, cwd=ROOT)


def test_the_run_line_solves_a_problem_that_sweeps_do_not(tmp_path):
    line = re.search(r"\./run examples/solve_fclib\.py (.*) --out", EXAMPLE.read_text()).group(1).split()
    done = go(*line, "--out", tmp_path)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    results = json.loads((tmp_path / "results.json").read_text())
    assert list(results) == ["dim", "contacts", "solver", "iterations", "error", "converged", "wall_time", "error_history"]
    assert results["converged"] is True and results["error"] <= 1e-8 and results["contacts"] == 52 and results["dim"] == 3
    assert min(results["error_history"]) == pytest.approx(results["error"], rel=1e-3)
    problem, (r, u) = grains.read_fclib(tmp_path / "solution.hdf5"), grains.read_solution(tmp_path / "solution.hdf5")
    assert problem.error(r) == results["error"]
    np.testing.assert_allclose(problem.W @ r + problem.q, u, atol=1e-12)
    assert (tmp_path / "error.png").stat().st_size > 5000


def test_what_is_not_solved_ends_in_status_1_and_is_written_all_the_same(tmp_path):
    done = go(BOXES, "--solver", "nlgs", "--max-iterations", 10, "--no-plots", "--out", tmp_path)
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "raise --max-iterations" in done.stderr
    assert json.loads((tmp_path / "results.json").read_text())["converged"] is False


@pytest.mark.parametrize("args, says", [(("none.hdf5",), "none.hdf5"), ((EXAMPLE,), "damaged or no FCLIB file"),
                                        ((BOXES, "--tolerance", "0"), "must be > 0"), ((BOXES, "--solver", "lu"), "invalid choice")])
def test_bad_input_is_one_line_and_status_2(tmp_path, args, says):
    done = go(*args, "--out", tmp_path)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and says in done.stderr

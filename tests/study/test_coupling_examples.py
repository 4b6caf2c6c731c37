"""Examples of grains in a fluid: their keys, their pictures, and how near they come to the drag law."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import quicksand

EXAMPLES = Path(__file__).parents[2] / "examples"
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(quicksand.__file__).parents[1]), "OMP_WAIT_POLICY": "passive", "OMP_NUM_THREADS": "1"}


def go(name, out, *args):
    return subprocess.run([sys.executable, EXAMPLES / f"{name}.py", *map(str, args), "--out", out], env=ENVIRONMENT, capture_output=True, text=True, timeout=200)


def results(name, out, *args, pictures=()):
    done = go(name, out, *args)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    found = json.loads((out / "results.json").read_text())
    text = (EXAMPLES / f"{name}.py").read_text().split('"""')[1]
    flags = set(re.findall(r"--([a-z-]+)", text))
    for key in found:
        assert key.replace("_", "-") in flags or re.search(rf"\b{key}\b", text.split("results.json")[-1]), f"{key} is not in the docstring"
    assert found["wall_time"] > 0
    for picture in pictures:
        assert (out / picture).stat().st_size > 10000
    return found


# Re 0.7, 134, 2e4; the last a light grain, which rises.
@pytest.mark.parametrize("args", [("--diameter", 1e-4, "--dt-over-tau", 100), ("--dt-over-tau", 0.05), ("--diameter", 2e-2, "--dim", 2, "--dt-over-tau", 100), ("--density", 100)])
def test_a_grain_in_a_fluid_at_rest_falls_as_the_law_says(tmp_path, args):
    found = results("terminal_velocity", tmp_path, *args, pictures=("velocity.png",))
    assert abs(found["error"]) < 1e-6
    assert found["steps"] * found["dt"] > 19.999 * found["tau"] and found["fluid_share"] is None


def test_a_grain_falls_too_fast_in_its_own_wake_the_more_so_the_narrower_that_is(tmp_path):
    errors = []
    for mesh_over_d in (2, 6):
        found = results("terminal_velocity", tmp_path, "--two-way", "--diameter", 1e-4, "--mesh-over-d", mesh_over_d)
        errors.append(found["error"])
        assert found["momentum_error"] < 1e-9 and found["volume_error"] < 1e-11 and found["carried_impulse"] < 1e-6
        assert 0.5 < found["fluid_share"] + found["exchange_share"] + found["grains_share"] <= 1
    assert 0.2 > errors[0] > errors[1] > 0.02


# Random beds: where they are denser the flow goes round, the finer the elements the better. Measured -0.42, -0.11, -0.10 and -1.2 %.
@pytest.mark.parametrize("args, most", [((), 0.005), (("--mesh-over-d", 6), 0.005), (("--dim", 3), 0.005), (("--open",), 0.02)])
def test_a_held_bed_has_the_pressure_gradient_of_the_law(tmp_path, args, most):
    found = results("packed_bed", tmp_path, *args)
    assert abs(found["error"]) < most
    assert found["momentum_error"] < 1e-11 and found["volume_error"] < 1e-10


def test_the_hat_breaks_on_elements_of_a_diameter_and_says_so(tmp_path):
    done = go("packed_bed", tmp_path, "--kernel", "hat", "--mesh-over-d", 0.7)
    assert done.returncode == 2 and "set_void_fraction: must be in (0, 1]" in done.stderr


@pytest.mark.parametrize("name, args, says", [("terminal_velocity", ("--density", 1000), "does not fall"), ("terminal_velocity", ("--diameter", 0), "must be > 0 m")])
def test_a_wrong_flag_is_one_line_and_status_2(tmp_path, name, args, says):
    done = go(name, tmp_path, *args)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and says in done.stderr, done.stderr
